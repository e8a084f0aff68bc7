"""Positions from row to row: jumps that no motion makes, whole turns lost, and readings held over several rows."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import medfilt

from armlink.recording.corrections import Corrections
from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.checks.clock import fast_rows
from sim_gap.checks.finding import Finding

JUMP, TIMES = 0.05, 8.0
"""Step from row to row from which a position jumps [rad], and its speed over the joint's 99th percentile."""
WRAPPED = 0.5
"""Distance of a jump from a whole turn below which it is one [rad]."""
HELD = 0.3
"""Share of the rows in fast motion that repeat all positions, from which they are held."""


def unwrapped(recording: Recording) -> tuple[Recording, list[Finding]]:
    """The recording with joints that turn on where their positions wrap around."""
    found, position = [], recording.position.copy()
    for j, q in enumerate(position.T):
        jumps = _jumps(recording.t, q)
        turns = np.round(jumps / (2.0 * np.pi))
        if not turns.any() or np.any(np.abs(jumps - 2.0 * np.pi * turns)[jumps != 0.0] > WRAPPED):
            continue
        position[:, j] = q - 2.0 * np.pi * np.concatenate([[0.0], np.cumsum(turns)])
        evidence = f"wraps around a whole turn, {np.count_nonzero(turns)} times: turned on from there"
        found.append(Finding("zero", "q", recording.names[j], evidence, "record it without wrapping", True))
    return (replace(recording, position=position), found) if found else (recording, [])


def find_jumps(recording: Recording, stated: Corrections) -> list[Finding]:
    """Places at which positions jump: pieces put together, or rows that are missing while the clock goes on."""
    if "t" in stated.clock:
        return []
    found = []
    for j, q in enumerate(recording.position.T):
        jumps = np.abs(_jumps(recording.t, q))
        row = int(jumps.argmax())
        if jumps[row] == 0.0:
            continue
        evidence = (
            f"jumps by {jumps[row]:.2f} rad from one row to the next at t = {recording.t[row + 1]:.2f} s: pieces put "
            "together, or rows missing whose time the clock does not show?"
        )
        option = "give each piece as a recording of its own, or --clock t=0 if it is right"
        found.append(Finding("dropped", "q", recording.names[j], evidence, option, False))
    return found


def _jumps(t: Array, q: Array) -> Array:
    """Steps of a position from row to row that no motion makes, 0 elsewhere, (K - 1,); a single reading is no jump."""
    there = np.isfinite(q)
    if there.sum() < 10:
        return np.zeros(len(q) - 1)
    steps = np.diff(medfilt(np.interp(t, t[there], q[there]), 3))
    speed = np.abs(steps) / np.maximum(np.diff(t), float(np.median(np.diff(t))))
    usual = float(np.quantile(speed, 0.99))
    return np.where((np.abs(steps) > JUMP) & (speed > TIMES * usual), steps, 0.0)


def without_held(recording: Recording) -> tuple[Recording, list[Finding]]:
    """The recording with positions that were read less often than the rows come, and repeated, filled in between."""
    same = _repeats(recording.position) & fast_rows(recording.position)
    share = float(same.sum()) / max(float(fast_rows(recording.position).sum()), 1.0)
    if share < HELD:
        return recording, []
    velocity = recording.velocity
    if velocity is not None and np.mean(_repeats(velocity)[same]) > 0.5:
        velocity = _filled(recording.t, velocity, ~same)
    position = _filled(recording.t, recording.position, ~same)
    evidence = f"repeats in {share:.0%} of the rows in motion while torques change: read less often; filled in between"
    found = Finding("duplicate", "q", "all", evidence, "record at the rate at which positions are read", True)
    return replace(recording, position=position, velocity=velocity), [found]


def _repeats(values: Array) -> NDArray[np.bool_]:
    """Rows in which all columns repeat the row before, (K,)."""
    return np.concatenate([[False], np.all(values[1:] == values[:-1], axis=1)])


def _filled(t: Array, values: Array, known: NDArray[np.bool_]) -> Array:
    """Values (K, n), between the rows that are known along straight lines."""
    return np.column_stack([np.interp(t, t[known], column[known]) for column in values.T])
