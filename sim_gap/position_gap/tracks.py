"""Recordings of commanded and measured positions on an even time base, with the model's torques along both."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armlink.errors import BadInput
from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.model.rigid_body import RigidArm
from sim_gap.residuals.resampling import coverage, interpolate_even, low_pass

SMOOTH_HZ, SMOOTH_SHARE = 15.0, 0.16
"""Pass band of the recorded motion: at most this, and this share of the recording's rate [Hz]."""
MODEL_HZ = 50.0
"""Rate at which the model's torques are computed [Hz]; they are interpolated between."""


@dataclass(frozen=True, eq=False)
class RecordingTrack:
    """One recording on the even time base of the simulation, (K, n) each."""

    t: Array
    signals: dict[str, Array]
    seen: Array
    period: float


def period_of(recording: Recording) -> float:
    """Median time from row to row [s]."""
    return float(np.median(np.diff(recording.t)))


def in_one_order(recordings: Sequence[Recording]) -> list[int]:
    """Numbers of recordings in an order that is the same however they were given."""

    def content(number: int) -> tuple[float, ...]:
        recording = recordings[number]
        command = np.nansum(recording.position_command) if recording.position_command is not None else 0.0
        return float(len(recording.t)), float(np.nansum(recording.position)), float(command)

    return sorted(range(len(recordings)), key=content)


def smoothing(period: float, dt: float) -> Callable[[Array], Array]:
    """The low pass of motion that was recorded every `period`, on a time base of `dt` [s]."""
    return low_pass(min(SMOOTH_HZ, SMOOTH_SHARE / period, 0.4 / dt), 1.0 / dt)


def track_of(arm: RigidArm, recording: Recording, label: str, dt: float) -> RecordingTrack:
    """Motion, command and the model's torques along both, on an even time base."""
    if recording.position_command is None or not np.isfinite(recording.position_command).any():
        raise BadInput(f"{label}: neither a torque channel nor a commanded position: record tau_1 … or q_cmd_1 …")
    period = period_of(recording)
    t = np.arange(recording.t[0], recording.t[-1], dt)
    raw = interpolate_even(recording.t, recording.position, t, label, "q")
    smooth = smoothing(period, dt)
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
    needed = whole + arm.spring_torque(q) + arm.nominal_joint_torque(v, a, still)
    return RecordingTrack(
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
            "feed": along(arm.torque, path, speed, push) + arm.armature * push,
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
    """Mean of the command, held from row to row, over a step about each t; 1 where there is one, else 0."""
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
    ends = np.concatenate([[recording.t[0] - dt], recording.t[1:], [recording.t[-1] + dt]])
    area = np.concatenate([np.zeros((1, filled.shape[1])), np.cumsum(filled * np.diff(ends)[:, None], axis=0)])
    edges = np.append(t, t[-1] + dt) - 0.5 * dt
    whole = np.column_stack([np.interp(edges, ends, column) for column in area.T])
    return np.diff(whole, axis=0) / dt, served
