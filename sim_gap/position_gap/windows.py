"""Recordings of commanded and measured positions, cut into windows for the simulation of every joint by itself.

Along the recorded motion of the other joints the equation of motion of joint j is one of its own: with e the deviation
of its angle from the recorded one, (M_jj + J) a + c + g cos e + g' sin e = u − friction. M_jj does not depend on q_j,
and gravity's torque about a hinge is exactly a sine of its angle, so that only the c of centrifugal and coupling
terms is taken at the recorded motion.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.model.rigid_body import RigidArm
from sim_gap.position_gap.surface import Surface
from sim_gap.position_gap.tracks import RecordingTrack, in_one_order, period_of, track_of

STEP_S = 0.0051
"""Longest step of the simulation [s]; the recording's period is a multiple of the step."""
WINDOW_S, WARM_S = 6.0, 1.5
"""Judged length of a window, and the simulated time before it that is not judged [s]."""
MOVES, FAST = 0.5, 0.8
"""Shares of a joint's largest RMS speed and largest speed of all windows that it has to have in one that is fitted."""
JUDGED_HZ = 50.0
"""Highest rate at which simulated and measured positions are compared [Hz]."""


@dataclass(frozen=True, eq=False)
class Windows:
    """W windows of T steps of J joints; arrays are (T, J, W) unless noted otherwise, SI units."""

    dt: float
    stride: int
    """Steps from one comparison to the next."""
    warm: int
    """Steps before the first comparison."""
    command: Array
    """Mean of the held command over a step about each time [rad]."""
    served: Array
    """1 while the servo is commanded, 0 where the command is missing."""
    speed: Array
    """Derivative of the command, smoothed [rad/s]."""
    recorded: Array
    """Smoothed recorded position [rad]."""
    inertia: Array
    gravity: Array
    slope: Array
    """M_jj [kg·m²], gravity's torque [N·m] and its derivative with respect to q_j [N·m/rad]."""
    coupling: Array
    """Torque of the other joints' accelerations and of all velocities [N·m]."""
    load: Array
    """Amount of the links' torque on the gear [N·m]."""
    feed: Array
    """Torque of the nominal links and rotors along the command [N·m]."""
    measured: Array
    """Measured position, (To, J, W) [rad]."""
    weight: Array
    """Weight of a sample, (To, J, W): 0 where nothing was measured, else 1, or less (`search.balanced`)."""
    start: Array
    """Position and velocity at the first step, (2, J, W)."""
    error_sum: Array
    """Integral of command minus position from the start of the recording to that of the window, (J, W) [rad·s]."""
    travel: Array
    """Way of the command from the start of the recording to that of the window, (J, W) [rad]."""
    first_error: Array
    """Command minus position at the start of the recording, (J, W) [rad]."""
    first_torque: Array
    """Torque that the links need there, less the feed-forward's, (2, J, W) [N·m]: without, with it."""
    recording: NDArray[np.intp]
    """Number of the recording from 0 of each window, (W,)."""
    scale: Array
    """The controller's gains in each window over those in the first recording, (W,)."""
    period: float
    """Longest sampling period of the recordings [s]."""
    time: Array
    """Time of the first comparison of each window [s], (W,)."""
    q: Array
    v: Array
    a: Array
    """Smoothed recorded motion, for the columns of link effects."""
    arm: RigidArm
    columns: dict[str, Array] = field(default_factory=dict)
    """Torque per unit of a parameter of the links or the arm [N·m], made by `with_columns`."""
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Lowest and highest coefficient of each column."""

    @property
    def joints(self) -> int:
        return int(self.command.shape[1])

    @property
    def count(self) -> int:
        return int(self.command.shape[2])

    @property
    def of_one_recording(self) -> bool:
        return len(np.unique(self.recording)) == 1


def windows_of(
    arm: RigidArm,
    recordings: Sequence[Recording],
    labels: Sequence[str],
    step: float = 0.0,
    scales: Sequence[float] = (),
    surface: Surface | None = None,
) -> Windows:
    """Cut recordings into windows, the same however they are ordered. Raises BadInput for one that holds no commanded
    position.

    `step` is the simulation's [s], by default a whole fraction of the recordings' period; `scales` are the controller's
    gains in each recording relative to the first, by default 1; what touches the `surface` does not count.
    """
    period = max(period_of(recording) for recording in recordings)
    dt = step or min(period_of(r) / math.ceil(period_of(r) / STEP_S - 1e-6) for r in recordings)
    stride = max(1, math.ceil(max(period, 1.0 / JUDGED_HZ) / dt - 1e-6))
    warm, length = (stride * round(s / dt / stride) for s in (WARM_S, WINDOW_S))
    parts: list[dict[str, Array]] = []
    for number in in_one_order(recordings):
        track = track_of(arm, recordings[number], labels[number], dt)
        if surface is not None:
            track.seen[surface.touched(arm, track.t, track.signals["q"])] = 0.0
        parts += _cut(arm, track, number, warm, length, stride)
    number_of = np.array([part["recording"] for part in parts], dtype=np.intp)
    stacked: dict[str, Any] = {
        name: np.stack([part[name] for part in parts], axis=-1) for name in parts[0] if name != "recording"
    }
    scale = np.array([*scales] or [1.0] * len(recordings), float)[number_of]
    return Windows(dt=dt, stride=stride, warm=warm, period=period, arm=arm, recording=number_of, scale=scale, **stacked)


def _cut(
    arm: RigidArm, track: RecordingTrack, number: int, warm: int, length: int, stride: int
) -> list[dict[str, Array]]:
    """Windows of one recording; the last is padded and counts only as long as it goes."""
    dt = float(track.t[1] - track.t[0])
    rows, total = len(track.t), warm + length
    error = (track.signals["command"] - track.signals["raw"]) * track.signals["served"]
    sums = np.vstack([np.zeros((1, arm.n)), np.cumsum(error, axis=0)[:-1] * dt])
    opening = slice(0, max(1, round(0.1 / dt)))
    first_error = error[opening].mean(0)
    needed = track.signals["needed"][opening].mean(0)
    first_torque = np.stack([needed, needed - track.signals["feed"][opening].mean(0)])
    kept = [name for name in track.signals if name not in ("needed", "raw")]
    out = []
    starts = range(0, max(rows - warm - round(0.5 / dt), 1), length)
    for start in starts:
        index = np.minimum(np.arange(start, start + total), rows - 1)
        judged = np.arange(start + warm, start + total, stride)
        inside = np.minimum(judged, rows - 1)
        out.append(
            {
                **{name: track.signals[name][index] for name in kept},
                "measured": track.signals["raw"][inside],
                "weight": track.seen[inside] * (judged < rows - 1)[:, None],
                "start": np.stack([track.signals["q"][start], track.signals["v"][start]]),
                "error_sum": sums[start],
                "travel": track.signals["command"][start] - track.signals["command"][0],
                "first_error": first_error,
                "first_torque": first_torque,
                "recording": np.asarray(number),
                "time": np.asarray(track.t[inside[0]]),
            }
        )
    return out


def thin(data: Windows, count: int) -> Windows:
    """At most `count` of the windows, evenly spread over the recordings."""
    return data if data.count <= count else choose_windows(data, _even(data.count, count))


def thin_moving(data: Windows, count: int) -> Windows:
    """The same, and for each joint that moves less in these than elsewhere the windows of its most and fastest motion.

    Of a joint that rests in all windows anything fits: no gain, and any friction. Of one that is slow in all of them
    nothing follows for fast motion.
    """
    if data.count <= count:
        return data
    chosen = _even(data.count, count)
    counts = data.weight.sum(0) > 0.0
    mean, most = np.sqrt(np.mean(data.v**2, axis=0)) * counts, np.abs(data.v).max(0) * counts
    for speed, share in ((mean, MOVES), (most, FAST)):
        rests = speed[:, chosen].max(1) < share * speed.max(1)
        chosen = np.unique([*chosen, *speed[rests].argmax(1)])
    return choose_windows(data, chosen)


def _even(total: int, count: int) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, total - 1, count).round().astype(np.intp))


def choose_windows(data: Windows, chosen: NDArray[np.intp]) -> Windows:
    values: dict[str, Any] = {name: x[..., chosen] for name, x in vars(data).items() if isinstance(x, np.ndarray)}
    return replace(data, **values, columns={name: x[..., chosen] for name, x in data.columns.items()})


def choose_joints(data: Windows, joints: Sequence[int]) -> Windows:
    chosen = list(joints)
    arrays = {name: x for name, x in vars(data).items() if isinstance(x, np.ndarray) and x.ndim >= 2}
    values: dict[str, Any] = {name: x[..., chosen, :] for name, x in arrays.items()}
    return replace(data, **values, columns={name: x[:, chosen] for name, x in data.columns.items()})
