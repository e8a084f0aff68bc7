"""Positions from row to row: jumps that no motion makes, whole turns lost, and seams of pieces put together."""

from dataclasses import replace

import numpy as np
from scipy.signal import medfilt

from armlink.recording.corrections import Corrections
from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.checks.finding import RecordingFinding
from sim_gap.checks.sampling import fill
from sim_gap.model.rigid_body import CREEP

JUMP, TIMES = 0.05, 8.0
"""Step from row to row from which a position jumps [rad], and its speed over what is usual at the joint."""
USUAL, MOVING = 0.99, 0.9
"""Usual speeds are these quantiles of all rows, and of those in motion: of a joint that mostly rests the first is 0."""
FEW_MOVING = 10
"""Least number of rows in motion that tell what is usual in it."""
HARD = 30.0
"""Acceleration from which a step is a jump [rad/s²]: in rows a tenth of a second apart an arm may get far."""
TURNS = 2.0 * np.pi, 360.0
"""A whole turn, also in recordings that turn out to be in degrees."""
WRAPPED = 0.08
"""Distance of a jump from a whole turn, in turns, below which it is one."""
BEYOND, KICK, NEAR = 1.2, 2.5, 5
"""Where pieces meet, two joints or more go farther beyond what their velocities before and after let them than anywhere
else, by the first factor, as their velocities jump by the second; anywhere else is so many rows away."""
LEAST_BEYOND, LEAST_KICK = 0.005, 0.05
"""Least distance [rad] and velocity [rad/s] of that: a sound recording misses single rows, too (0.002 and 0.002)."""
TOGETHER = "were separate pieces joined here, or are rows missing?"
SETTLED = "split the file there and give both parts, or give --clock t=0 to use it as it is"


def unwrap(recording: Recording) -> tuple[Recording, list[RecordingFinding]]:
    """The recording with joints that turn on where their positions wrap around."""
    found, position = [], recording.position.copy()
    for j, q in enumerate(position.T):
        jumps = _jumps(recording.t, q)
        for turn in TURNS:
            turns = np.round(jumps / turn)
            if not turns.any() or np.any(np.abs(jumps / turn - turns)[jumps != 0.0] > WRAPPED):
                continue
            position[:, j] = q - turn * np.concatenate([[0.0], np.cumsum(turns)])
            evidence = (
                f"the position jumps by a whole turn, {np.count_nonzero(turns)} times; these jumps were taken out"
            )
            found.append(
                RecordingFinding(
                    "zero", "q", recording.names[j], evidence, "record the position without wrapping", True
                )
            )
            break
    return (replace(recording, position=position), found) if found else (recording, [])


def find_jumps(recording: Recording, stated: Corrections) -> list[RecordingFinding]:
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
            f"the position jumps by {jumps[row]:.2f} rad from one row to the next at t = "
            f"{recording.t[row + 1]:.2f} s: {TOGETHER}"
        )
        found.append(RecordingFinding("dropped", "q", recording.names[j], evidence, SETTLED, False))
    return found


def _jumps(t: Array, q: Array) -> Array:
    """Steps of a position from row to row that no motion makes, 0 elsewhere, (K - 1,); a single reading is no jump."""
    there = np.isfinite(q)
    if there.sum() < 10:
        return np.zeros(len(q) - 1)
    steps = np.diff(medfilt(np.interp(t, t[there], q[there]), 3))
    time = np.maximum(np.diff(t), float(np.median(np.diff(t))))
    speed = np.abs(steps) / time
    moving = speed[speed > CREEP]
    usual = float(np.quantile(speed, USUAL))
    if moving.size >= FEW_MOVING:
        usual = max(usual, float(np.quantile(moving, MOVING)))
    beside = 0.5 * (np.append(steps[1:], 0.0) + np.append(0.0, steps[:-1]))
    hard = np.abs(steps - beside) > HARD * time**2
    return np.where((np.abs(steps) > JUMP) & (speed > TIMES * usual) & hard, steps, 0.0)


def find_seam(recording: Recording, stated: Corrections) -> list[RecordingFinding]:
    """A row after which several joints go on from elsewhere and at another velocity: pieces whose ends are near."""
    if "t" in stated.clock or recording.velocity is None or recording.t.size < 10 * NEAR:
        return []
    t, time = recording.t, np.diff(recording.t)[:, None]
    q, v = (fill(t, values, np.isfinite(values)) for values in (recording.position, recording.velocity))
    allowed = 0.5 * time * np.abs(np.diff(v, axis=0))
    beyond = np.maximum(np.abs(np.diff(q, axis=0) - 0.5 * time * (v[1:] + v[:-1])) - allowed, 0.0)
    slope = (v[2:] - v[:-2]) / (t[2:] - t[:-2])[:, None]
    kick = np.abs(np.diff(v, axis=0)[2:-2] - 0.5 * time[2:-2] * (slope[:-3] + slope[3:]))
    beyond = beyond[2:-2]
    both = (_over_the_rest(beyond) > BEYOND) & (beyond > LEAST_BEYOND)
    both &= (_over_the_rest(kick) > KICK) & (kick > LEAST_KICK)
    row = int(both.sum(axis=1).argmax())
    joints = [recording.names[j] for j in np.flatnonzero(both[row])]
    if len(joints) < 2:
        return []
    evidence = (
        f"this joint and {', '.join(joints[1:])} move farther than their velocities allow, and their "
        f"velocities jump as well, at t = {t[row + 3]:.2f} s: {TOGETHER}"
    )
    return [RecordingFinding("dropped", "q", joints[0], evidence, SETTLED, False)]


def _over_the_rest(size: Array) -> Array:
    """Values over the largest that is not near their own largest, by column (K, n); 0 in columns of zeros."""
    far = np.abs(np.arange(len(size))[:, None] - size.argmax(axis=0)) > NEAR
    rest = np.where(far, size, 0.0).max(axis=0)
    return np.where(rest > 1e-9, size / np.maximum(rest, 1e-9), 0.0)
