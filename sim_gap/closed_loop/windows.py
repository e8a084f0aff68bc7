"""Recordings of commanded and measured positions, cut into windows for the simulation of every joint by itself.

Along the recorded motion of the other joints the equation of motion of joint j is one of its own: with e the deviation
of its angle from the recorded one, (M_jj + J) a + c + g cos e + g' sin e = u − friction. M_jj does not depend on q_j,
and gravity's torque about a hinge is exactly a sine of its angle, so that only the c of centrifugal and coupling
terms is taken at the recorded motion.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from armlink.errors import BadInput
from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.model.rigid_body import RigidArm
from sim_gap.residuals.resampling import bridged, coverage, low_pass

STEP_S = 0.0051
"""Longest step of the simulation [s]; the recording's period is a multiple of the step."""
WINDOW_S, WARM_S = 6.0, 1.5
"""Judged length of a window, and the simulated time before it that is not judged [s]."""
JUDGED_HZ = 50.0
"""Highest rate at which simulated and measured positions are compared [Hz]."""
SMOOTH_HZ, SMOOTH_SHARE = 15.0, 0.16
"""Pass band of the recorded motion: at most this, and this share of the recording's rate [Hz]."""
MODEL_HZ = 30.0
"""Rate at which the model's torques are computed [Hz]; they are interpolated between."""


@dataclass(frozen=True, eq=False)
class Windows:
    """W windows of T steps of J joints; arrays are (T, J, W) unless noted otherwise, SI units."""

    dt: float
    stride: int
    """Steps from one comparison to the next."""
    warm: int
    """Steps before the first comparison."""
    command: Array
    """Mean of the held command over each step [rad]."""
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
    """Torque of the nominal model along the command [N·m]."""
    feed_gravity: Array
    """Its gravity alone [N·m]."""
    measured: Array
    """Measured position, (To, J, W) [rad]."""
    weight: Array
    """1 where it counts, (To, J, W)."""
    start: Array
    """Position and velocity at the first step, (2, J, W)."""
    error_sum: Array
    """Integral of command minus position from the start of the recording to that of the window, (J, W) [rad·s]."""
    first_error: Array
    """Command minus position at the start of the recording, (J, W) [rad]."""
    first_torque: Array
    """Torque that the links need there, less the feed-forward's, (2, J, W) [N·m]: without, with it."""
    recording: NDArray[np.intp]
    """Number of the recording from 0 of each window, (W,)."""
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
    """Torque per unit of a parameter of the links or the arm [N·m], made by `columns_of`."""

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.command.shape[1])

    @property
    def count(self) -> int:
        """Number of windows."""
        return int(self.command.shape[2])


@dataclass(frozen=True, eq=False)
class Track:
    """One recording on the even time base of the simulation, (K, n) each."""

    t: Array
    signals: dict[str, Array]
    seen: Array
    period: float


def windows_of(arm: RigidArm, recordings: Sequence[Recording], labels: Sequence[str], step: float = 0.0) -> Windows:
    """Cut recordings into windows. Raises BadInput for one that holds no commanded position."""
    period = max(_period(recording) for recording in recordings)
    dt = step or min(_period(r) / math.ceil(_period(r) / STEP_S - 1e-6) for r in recordings)
    stride = max(1, math.ceil(max(period, 1.0 / JUDGED_HZ) / dt - 1e-6))
    warm, length = (stride * round(s / dt / stride) for s in (WARM_S, WINDOW_S))
    parts: list[dict[str, Array]] = []
    for number, (recording, label) in enumerate(zip(recordings, labels, strict=True)):
        track = _track(arm, recording, label, dt)
        parts += _cut(arm, track, number, warm, length, stride)
    stacked = {name: np.stack([part[name] for part in parts], axis=-1) for name in parts[0]}
    stacked["recording"] = stacked["recording"].astype(np.intp)
    return Windows(dt=dt, stride=stride, warm=warm, period=period, arm=arm, **stacked)


def _period(recording: Recording) -> float:
    return float(np.median(np.diff(recording.t)))


def _track(arm: RigidArm, recording: Recording, label: str, dt: float) -> Track:
    """Motion, command and the model's torques along both, on an even time base."""
    if recording.position_command is None or not np.isfinite(recording.position_command).any():
        raise BadInput(f"{label}: neither a torque channel nor a commanded position: record tau_1 … or q_cmd_1 …")
    period = _period(recording)
    t = np.arange(recording.t[0], recording.t[-1], dt)
    raw = bridged(recording.t, recording.position, t, label, "q")
    cut = min(SMOOTH_HZ, SMOOTH_SHARE / period, 0.4 / dt)
    smooth = low_pass(cut, 1.0 / dt)
    q = smooth(raw)
    v = np.gradient(q, dt, axis=0)
    a = np.gradient(v, dt, axis=0)
    held, served = held_command(recording, t, dt)
    path = smooth(held)
    speed = np.gradient(path, dt, axis=0)
    push = np.gradient(speed, dt, axis=0)
    rough = max(1, round(1.0 / (MODEL_HZ * dt)))

    def along(torque: Callable[..., Array], *motion: Array) -> Array:
        """A torque of the model at a lower rate, interpolated."""
        few = torque(*(x[::rough] for x in motion))
        return np.column_stack([np.interp(t, t[::rough], column) for column in few.T])

    still = np.zeros_like(q)
    gravity = along(arm.torque, q, still, still)
    own = along(lambda x: np.hstack(_own_terms(arm, x)), q)
    inertia, slope = own[:, : arm.n], own[:, arm.n :]
    whole = along(arm.torque, q, v, a)
    needed = whole + arm.nominal_joint_torque(q, v, a, still)
    return Track(
        t,
        {
            "command": held,
            "served": served,
            "speed": speed,
            "recorded": q,
            "inertia": np.maximum(inertia, 1e-7),
            "gravity": gravity,
            "slope": slope,
            "coupling": whole - gravity - inertia * a,
            "load": np.abs(low_pass(min(3.0, 0.4 / dt), 1.0 / dt)(whole)),
            "feed": along(arm.torque, path, speed, push) + arm.nominal_joint_torque(path, speed, push, np.tanh(speed / 0.02)),
            "feed_gravity": along(arm.torque, path, still, still),
            "q": q,
            "v": v,
            "a": a,
            "needed": needed,
            "raw": raw,
        },
        coverage(recording.t, recording.position, t),
        period,
    )


def _own_terms(arm: RigidArm, q: Array) -> tuple[Array, Array]:
    """M_jj and the derivative of gravity's torque with respect to the joint's own angle, (K, n) each."""
    still, step = np.zeros_like(q), 1e-4
    gravity = arm.torque(q, still, still)
    slope, inertia = np.empty_like(q), np.empty_like(q)
    for j in range(arm.n):
        ahead, unit = q.copy(), still.copy()
        ahead[:, j] += step
        unit[:, j] = 1.0
        slope[:, j] = (arm.torque(ahead, still, still)[:, j] - gravity[:, j]) / step
        inertia[:, j] = arm.torque(q, still, unit, np.zeros(3))[:, j]
    return inertia, slope


def held_command(recording: Recording, t: Array, dt: float) -> tuple[Array, Array]:
    """Mean of the command over each step from t to t + dt, held from row to row; 1 where there is one, else 0."""
    given = recording.position_command
    assert given is not None
    last = np.clip(np.searchsorted(recording.t, t + 1e-9, side="right") - 1, 0, len(recording.t) - 1)
    served = np.isfinite(given[last]).astype(float)
    filled = given.copy()
    for j in range(filled.shape[1]):
        there = np.isfinite(filled[:, j])
        order = np.maximum.accumulate(np.where(there, np.arange(len(there)), 0))
        filled[:, j] = filled[order, j] if there.any() else 0.0
        first = int(np.argmax(there))
        filled[:first, j] = filled[first, j]
    span = np.diff(recording.t, append=recording.t[-1] + dt)
    area = np.concatenate([np.zeros((1, filled.shape[1])), np.cumsum(filled * span[:, None], axis=0)])
    ends = np.append(recording.t, recording.t[-1] + dt)
    edges = np.append(t, t[-1] + dt)
    whole = np.column_stack([np.interp(edges, ends, column) for column in area.T])
    return np.diff(whole, axis=0) / dt, served


def _cut(arm: RigidArm, track: Track, number: int, warm: int, length: int, stride: int) -> list[dict[str, Array]]:
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
                "first_error": first_error,
                "first_torque": first_torque,
                "recording": np.asarray(number),
                "time": np.asarray(track.t[inside[0]]),
            }
        )
    return out


def thinned(data: Windows, count: int) -> Windows:
    """At most `count` of the windows, evenly spread over the recordings."""
    if data.count <= count:
        return data
    chosen = np.unique(np.linspace(0, data.count - 1, count).round().astype(int))
    values = {name: x[..., chosen] for name, x in vars(data).items() if isinstance(x, np.ndarray)}
    return replace(data, **values, columns={name: x[..., chosen] for name, x in data.columns.items()})


def of_joints(data: Windows, joints: Sequence[int]) -> Windows:
    """The windows of some joints."""
    chosen = list(joints)
    arrays = {name: x for name, x in vars(data).items() if isinstance(x, np.ndarray) and x.ndim >= 2}
    values = {name: x[..., chosen, :] for name, x in arrays.items()}
    return replace(data, **values, columns={name: x[:, chosen] for name, x in data.columns.items()})
