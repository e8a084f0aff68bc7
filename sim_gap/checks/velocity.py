"""The recorded velocity and commanded position against the measured position."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from armlink.recording.corrections import Corrections
from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.checks.finding import RecordingFinding, exchange_option

SCALE = 0.7, 1.4
"""Velocity over derivative of the position outside which they disagree."""
AGREES = 0.9
"""Correlation from which two columns are the same motion."""
LATE_S, LATE_ROWS = 0.04, 1.5
"""Delay of the recorded velocity from which it is filtered: both in seconds and in rows."""


def follows_position(recording: Recording) -> tuple[str, ...]:
    """Channels of `dq` and `q_cmd` whose columns go with those of the position as they are."""
    rate = np.gradient(recording.position, recording.t, axis=0)
    found = []
    for prefix, values, own in (
        ("dq", recording.velocity, rate),
        ("q_cmd", recording.position_command, recording.position),
    ):
        if values is not None and _same(values, own):
            found.append(prefix)
    return tuple(found)


def _same(values: Array, own: Array) -> bool:
    """Whether columns go with those of another channel, in the same unit."""
    there = np.isfinite(values).all(axis=1) & np.isfinite(own).all(axis=1)
    x, y = values[there] - values[there].mean(0), own[there] - own[there].mean(0)
    moves = (x.std(0) > 1e-6) & (y.std(0) > 1e-6)
    if not moves.any():
        return False
    x, y = x[:, moves], y[:, moves]
    slope = (x * y).sum(0) / (y**2).sum(0)
    match = (x * y).sum(0) / np.sqrt((x**2).sum(0) * (y**2).sum(0))
    low, high = SCALE
    return bool(np.median(match) > 0.7 and low < np.median(slope) < high)


def sound_velocity(recording: Recording, stated: Corrections) -> tuple[Recording, list[RecordingFinding]]:
    """The recording, its velocity left out if it is not the derivative of the position."""
    if recording.velocity is None:
        return recording, []
    found = _findings(recording, recording.velocity, stated)
    return (replace(recording, velocity=None), found) if found else (recording, [])


def _findings(recording: Recording, velocity: Array, stated: Corrections) -> list[RecordingFinding]:
    rate = np.gradient(recording.position, recording.t, axis=0)
    there = np.isfinite(rate).all(axis=1) & np.isfinite(velocity).all(axis=1)
    rate, velocity = rate[there], velocity[there]
    moves = np.flatnonzero((rate.std(0) > 0.02) & (velocity.std(0) > 1e-9))
    if not moves.size:
        return []
    match = np.corrcoef(velocity[:, moves].T, rate[:, moves].T)[: moves.size, moves.size :]
    best = np.abs(match).argmax(axis=1)
    clear = np.abs(match).max(axis=1) > AGREES
    scale = np.array([velocity[:, j] @ rate[:, j] / (rate[:, j] @ rate[:, j]) for j in moves])
    own = clear & (best == np.arange(moves.size))
    low, high = SCALE
    wrong = {
        "order": (
            clear & (best != np.arange(moves.size)) & (np.abs(np.diag(match)) < 0.5),
            "the velocity belongs to another joint",
        ),
        "sign": (own & (scale < 0.0), "the velocity has the opposite sign of the derivative of the position"),
        "scale": (
            own & (scale > 0.0) & ~((low < scale) & (scale < high)),
            "the velocity differs in size from the derivative of the position",
        ),
    }
    found = []
    for kind, (joints, what) in wrong.items():
        names = [j for j in moves[joints] if not stated.states("sign" if kind == "sign" else "units", f"dq_{j + 1}")]
        if names:
            evidence = (
                f"{what} ({_listed(kind, names, moves, best, scale, recording.names)}), so it is left out of "
                "the diagnosis"
            )
            joint = "all" if len(names) == len(moves) else recording.names[names[0]]
            found.append(RecordingFinding(kind, "dq", joint, evidence, _option(kind, names, moves, best), True))  # type: ignore[arg-type]
    if not found and own.any() and not stated.states("units", "dq_1"):
        late = _delay(recording, rate[:, moves], velocity[:, moves])
        if late:
            evidence = (
                f"the velocity lags {late * 1e3:.0f} ms behind the derivative of the position, as after a "
                "filter, so it is left out"
            )
            found.append(
                RecordingFinding("filter", "dq", "all", evidence, "--units dq=rad (to keep the velocity)", True)
            )
    return found


def _listed(
    kind: str, joints: list[int], moves: NDArray[np.int_], best: NDArray[np.int_], scale: Array, names: tuple[str, ...]
) -> str:
    place = {int(j): i for i, j in enumerate(moves)}
    if kind == "order":
        return ", ".join(f"{names[j]} holds {names[int(moves[best[place[j]]])]}" for j in joints)
    return ", ".join(f"{names[j]} {scale[place[j]]:.3g} times" for j in joints)


def _option(kind: str, joints: list[int], moves: NDArray[np.int_], best: NDArray[np.int_]) -> str:
    place = {int(j): i for i, j in enumerate(moves)}
    if kind == "order":
        option = exchange_option("dq", {j: int(moves[best[place[j]]]) for j in joints})
        return option or "--units " + ",".join(f"dq_{j + 1}=rad" for j in joints) + " (to keep the velocity)"
    return f"--{'sign' if kind == 'sign' else 'units'} " + ",".join(
        f"dq_{j + 1}={'-1' if kind == 'sign' else 'deg'}" for j in joints
    )


def _delay(recording: Recording, rate: Array, velocity: Array) -> float:
    """Delay of the velocity behind the position's derivative [s], 0 where it is too short to matter."""
    period = float(np.median(np.diff(recording.t)))
    longest = max(2, min(len(rate) // 4, round(0.3 / period)))
    match = [float((rate[: len(rate) - k] * velocity[k:]).sum(0) @ (1.0 / (rate**2).sum(0))) for k in range(longest)]
    rows = int(np.argmax(match))
    late = rows * period
    return late if rows > LATE_ROWS and late > LATE_S else 0.0
