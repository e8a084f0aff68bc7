"""Recordings of commanded and measured positions, cut into windows in which the user's model runs free.

A recording ends where rows are missing or a position makes a step that no motion makes: what comes after is a piece
that begins afresh, as the short roll-outs of a data set do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armlink.errors import BadInput
from armlink.recording.recording import Recording, slice_rows
from gcomp.arrays import Array
from sim_gap.model.load import SimModel
from sim_gap.position_gap.plant import MovedModel, Piece
from sim_gap.residuals.preprocess import at_times, low_pass

WINDOW_S, WARM_S = 3.0, 1.0
"""Judged length of a window, and the simulated time before it that is not judged [s]; a piece that is not as long as a
window begins as it was recorded and is judged from there."""
LEAST_S = 0.2
"""Length of a piece that shows any motion [s]."""
JUDGED_HZ = 50.0
"""Highest rate at which simulated and measured positions are compared [Hz]."""
SMOOTH_HZ, SMOOTH_SHARE = 15.0, 0.16
"""Pass band of the recorded motion: at most this, and this share of the recording's rate [Hz]."""
MISSING_ROWS, MISSING_S = 6.0, 0.25
"""Time without a row at which a piece ends: in periods, and at least [s]."""
STEP_RATIO, STEP_RAD = 6.0, 0.05
"""Step of a position that no motion makes: this many times the larger of the steps beside it, and this much more."""
BEGINNING_S, BEGINNING_ROWS = 0.02, 5
"""Time between the positions from which the velocity at the start of a short piece follows [s]; rows that it needs."""
SLOPE_NOISE = np.sqrt(26.0) / 2.0
"""Noise of the slope at the first of three positions, over that of a position and the time between them."""
NOISE_SIZES = 3.0
"""Standard deviations of noise that a velocity has to exceed."""
MOVES, FAST = 0.5, 0.8
"""Shares of a joint's largest RMS speed and largest speed of all windows that it has to have in one that is fitted."""


@dataclass(frozen=True, eq=False)
class Windows:
    """W windows of J joints, compared with the model at up to To times; SI units."""

    plant: MovedModel
    """The model that is moved along the commands."""
    pieces: tuple[Piece, ...]
    piece: NDArray[np.intp]
    """Number of the piece of each window, (W,)."""
    begin: Array
    """Time at which the simulation of each window begins, in its piece's time [s], (W,)."""
    at: Array
    """Time of each comparison after that [s], (To, W)."""
    measured: Array
    """Measured position, (To, J, W) [rad]."""
    weight: Array
    """1 where something was measured, else 0, (To, J, W)."""
    start: Array
    """Position and velocity at the beginning, (2, J, W)."""
    error_sum: Array
    """Integral of command minus position from the piece's start to the window's, (J, W) [rad·s]."""
    first: Array
    """Position at the start of the piece, (J, W) [rad]."""
    v: Array
    """Velocity, (To, J, W) [rad/s]."""
    torque: Array
    """Torque that the nominal links ask for along the recorded motion, (To, J, W) [N·m]."""
    error: Array
    """Command minus position, (To, J, W) [rad]; 0 where there is no command."""
    served: Array
    """1 while the servo is commanded, (To, J, W)."""
    noise: Array
    """Standard deviation of the readings of the piece about a smooth course, (J, W) [rad]."""
    recording: NDArray[np.intp]
    """Number of the recording of each window, (W,)."""
    scale: Array
    """The controller's gains in each window over those in the first recording, (W,)."""
    period: float
    """Longest sampling period of the recordings [s]."""
    judged_s: float
    """Time from one comparison to the next [s]."""

    @property
    def joints(self) -> int:
        return int(self.measured.shape[1])

    @property
    def count(self) -> int:
        return int(self.measured.shape[2])

    @property
    def of_one_recording(self) -> bool:
        return len(np.unique(self.recording)) == 1


def period_of(recording: Recording) -> float:
    """Median time from row to row [s]."""
    return float(np.median(np.diff(recording.t)))


def pieces_of(recording: Recording) -> list[slice]:
    """Rows of the parts of a recording without a gap or a step that no motion makes."""
    t, period = recording.t, period_of(recording)
    gap = np.diff(t) > max(MISSING_ROWS * period, MISSING_S)
    step = np.abs(np.diff(recording.position, axis=0))
    step = np.where(np.isfinite(step), step, 0.0)
    beside = np.zeros_like(step)
    beside[1:] = step[:-1]
    beside[:-1] = np.maximum(beside[:-1], step[1:])
    jump = np.asarray((step > STEP_RATIO * beside + STEP_RAD).any(axis=1))
    # a single wild reading makes two steps, there and back, and ends nothing
    back = jump[1:] & jump[:-1]
    jump[1:] &= ~back
    jump[:-1] &= ~back
    ends = np.flatnonzero(gap | jump) + 1
    edges = [0, *ends.tolist(), len(t)]
    return [slice(a, b) for a, b in pairwise(edges) if t[b - 1] - t[a] >= LEAST_S]


def windows_of(
    plant: MovedModel, recordings: Sequence[Recording], labels: Sequence[str], scales: Sequence[float] = ()
) -> Windows:
    """Cut recordings with commands into windows, the same however they are ordered. Raises BadInput if none is long
    enough.

    `scales` are the controller's gains in each recording relative to the first, by default 1.
    """
    period = max(period_of(recording) for recording in recordings)
    pieces: list[Piece] = []
    parts: list[dict[str, Any]] = []
    for number in _in_one_order(recordings):
        recording = recordings[number]
        for rows in pieces_of(recording):
            part = slice_rows(recording, rows)
            if np.isfinite(part.position).all(axis=1).sum() < BEGINNING_ROWS:
                continue
            piece, made = _cut(plant.sim, part, number, len(pieces))
            if made:
                pieces.append(piece)
                parts += made
    if not parts:
        raise BadInput(f"{labels[0]}: there are no {LEAST_S:g} s of position readings without a break")
    longest = max(len(part["at"]) for part in parts)
    stacked = {name: np.stack([_padded(part[name], longest, name) for part in parts], axis=-1) for name in parts[0]}
    number_of = stacked.pop("recording").astype(np.intp)
    scale = np.array([*scales] or [1.0] * len(recordings), float)[number_of]
    own = stacked.pop("piece").astype(np.intp)
    every = [1.0 / JUDGED_HZ, period]
    return Windows(
        plant, tuple(pieces), own, recording=number_of, scale=scale, period=period, judged_s=max(every), **stacked
    )


PER_SAMPLE = ("at", "measured", "weight", "v", "torque", "error", "served")


def _padded(given: Any, longest: int, name: str) -> Array:
    """Values of a window with as many samples as the longest has, the last repeated without weight."""
    values: Array = np.asarray(given, float)
    if name not in PER_SAMPLE or len(values) == longest:
        return values
    more: Array = np.repeat(values[-1:], longest - len(values), axis=0)
    return np.concatenate([values, 0.0 * more if name == "weight" else more])


def _piece(sim: SimModel, part: Recording, given: Array, start: Array, velocity: Array) -> Piece:
    """The commands (K, n) of a part that begins with these positions and velocities, (n,) each."""
    served, filled = np.isfinite(given), given.copy()
    for j in range(filled.shape[1]):
        there = served[:, j]
        order = np.maximum.accumulate(np.where(there, np.arange(len(there)), 0))
        filled[:, j] = filled[order, j] if there.any() else part.position[0, j]
        filled[: int(np.argmax(there)), j] = filled[int(np.argmax(there)), j]
    ends = np.append(part.t, part.t[-1] + period_of(part)) - part.t[0]
    area = np.vstack([np.zeros((1, filled.shape[1])), np.cumsum(filled * np.diff(ends)[:, None], axis=0)])
    asked = sim.arm.gravity_torque(start[None])[0] + sim.arm.spring_torque(start)
    return Piece(ends, area, served, start, asked, served[0] & (velocity == 0.0))


def _cut(sim: SimModel, part: Recording, number: int, piece: int) -> tuple[Piece, list[dict[str, Any]]]:
    t, q = part.t - part.t[0], part.position
    seen = np.isfinite(q)
    filled = at_times(t, t, q)
    noise = _noise(filled)
    q0, v0 = _beginning(t, filled, noise)
    smooth, v, a = _smoothed(t, filled)
    arm = sim.arm
    torque = arm.torque(smooth, v, a) + arm.spring_torque(smooth) + arm.armature * a
    given = part.position_command
    assert given is not None
    served = np.isfinite(given)
    error = np.where(served, np.where(served, given, 0.0) - filled, 0.0)
    sums = np.vstack([np.zeros((1, arm.n)), np.cumsum(error[:-1] * np.diff(t)[:, None], axis=0)])
    stride = max(1, round(1.0 / (JUDGED_HZ * period_of(part))))
    short = t[-1] < WINDOW_S
    warm, out, begin = 0.0 if short else WARM_S, [], 0.0
    while begin + warm < t[-1] - min(0.5, 0.5 * t[-1]):
        first = int(np.searchsorted(t, begin - 1e-9))
        rows = np.arange(int(np.searchsorted(t, t[first] + warm - 1e-9)), len(t), stride)
        rows = rows[t[rows] < t[first] + warm + WINDOW_S]
        rows = rows[1:] if short else rows
        if not len(rows):
            break
        state = np.stack([q0, v0]) if first == 0 and short else np.stack([smooth[first], v[first]])
        out.append(
            {
                "piece": piece,
                "begin": t[first],
                "at": t[rows] - t[first],
                "measured": filled[rows],
                "weight": seen[rows],
                "start": state,
                "error_sum": sums[first],
                "first": smooth[0],
                "v": v[rows],
                "torque": torque[rows],
                "error": error[rows],
                "served": served[rows],
                "noise": noise,
                "recording": number,
            }
        )
        begin = t[first] + WINDOW_S
    return _piece(sim, part, given, q0, v0), out


def _noise(q: Array) -> Array:
    """Standard deviation of readings about a cubic through those beside them, in the calmer half of the rows, (n,)."""
    bent = np.diff(q, 4, axis=0)  # of white noise it has 70 times the variance (the sum of squared binomials)
    if not len(bent):
        return np.zeros(q.shape[1])
    return np.asarray(1.4826 * np.median(np.abs(bent), axis=0) / np.sqrt(70.0))


def _smoothed(t: Array, q: Array) -> tuple[Array, Array, Array]:
    """Smoothed position, velocity and acceleration at the rows, (K, n) each."""
    period = float(np.median(np.diff(t)))
    even = np.arange(0.0, t[-1] + 0.5 * period, period)
    raw = at_times(even, t, q)
    smoothed = low_pass(min(SMOOTH_HZ, SMOOTH_SHARE / period), 1.0 / period)
    smooth = smoothed(raw) if len(even) > 3 * BEGINNING_ROWS else raw
    v = np.gradient(smooth, period, axis=0)
    a = np.gradient(v, period, axis=0)
    return at_times(t, even, smooth), at_times(t, even, v), at_times(t, even, a)


def _beginning(t: Array, q: Array, noise: Array) -> tuple[Array, Array]:
    """Position and velocity at the first row; 0 for a velocity that noise, or a motion that only begins, may make.

    The velocity is the parabola's through three positions, in doubt by what it changes by from one to the next.
    """
    apart = min(max(1, round(BEGINNING_S / float(np.median(np.diff(t))))), (len(t) - 1) // 2)
    (early, late), (before, after) = np.diff(t[: 2 * apart + 1 : apart]), np.diff(q[: 2 * apart + 1 : apart], axis=0)
    change = after / late - before / early
    v = before / early - change * early / (early + late)
    doubt = np.maximum(np.abs(change), NOISE_SIZES * SLOPE_NOISE * noise / early)
    return q[0], np.where(np.abs(v) > doubt, v, 0.0)


def _in_one_order(recordings: Sequence[Recording]) -> list[int]:
    """Numbers of recordings in an order that is the same however they were given."""

    def content(number: int) -> tuple[float, ...]:
        recording = recordings[number]
        command = np.nansum(recording.position_command) if recording.position_command is not None else 0.0
        return float(len(recording.t)), float(np.nansum(recording.position)), float(command)

    return sorted(range(len(recordings)), key=content)


def thin(data: Windows, count: int, moving: bool = False) -> Windows:
    """As much of the windows as `count` whole ones, spread evenly over the recordings; with `moving` the windows of the
    most and fastest motion too, of each joint that moves less in these than elsewhere.

    Of a joint that rests in all windows anything fits: no gain, and any friction. Of one that is slow in all of them
    nothing follows for fast motion.
    """
    seconds = (data.weight > 0.0).any(axis=1).sum() * data.judged_s
    count = max(count, round(count * WINDOW_S * data.count / max(float(seconds), WINDOW_S)))  # some may be shorter
    if data.count <= count:
        return data
    chosen = np.unique(np.linspace(0, data.count - 1, count).round().astype(np.intp))
    counts = data.weight.sum(0) > 0.0
    mean, most = np.sqrt(np.mean(data.v**2, axis=0)) * counts, np.abs(data.v).max(0) * counts
    for speed, share in ((mean, MOVES), (most, FAST)) if moving else ():
        rests = speed[:, chosen].max(1) < share * speed.max(1)
        chosen = np.unique([*chosen, *speed[rests].argmax(1)])
    return choose_windows(data, chosen)


def choose_windows(data: Windows, chosen: NDArray[np.intp]) -> Windows:
    values: dict[str, Any] = {name: x[..., chosen] for name, x in vars(data).items() if isinstance(x, np.ndarray)}
    return replace(data, **values)
