"""Positions that no joint can have and no motion makes: counts, angles beyond a range, jumps, lost turns, seams."""

from dataclasses import replace

import numpy as np
from scipy.signal import medfilt

from armlink.recording.corrections import Corrections
from armlink.recording.recording import Recording
from gcomp.arm.rigid_body import CREEP, RigidArm
from gcomp.arrays import Array, Mask
from sim_gap.checks.finding import RecordingFinding
from sim_gap.residuals.preprocess import at_times

BEYOND_RANGE = 0.2
"""Distance beyond the end of its range from which a joint is not there [rad]; zeros and soft limits differ by less."""
FULL = 100.5
"""Largest position in per cent of a range, with a half for rounding."""
CLOSED = 0.25
"""A range begins near zero if its lower end is no further below than this share of the upper one is above."""
FAR = 20.0
"""Range of a position [rad] from which whole numbers alone are counts, and a servo's turns are likely degrees."""


def find_counts(recording: Recording, stated: Corrections) -> RecordingFinding | None:
    """Positions of whole numbers alone: counts of encoders, of which the number a turn has to be given."""
    for j, q in enumerate(recording.position.T):
        q = q[np.isfinite(q)]
        if stated.states("units", f"q_{j + 1}") or not q.size or np.ptp(q) < FAR or np.any(q != np.round(q)):
            continue
        follows = ",q_cmd=counts:TURN" if recording.position_command is not None else ""
        evidence = (
            f"the column holds whole numbers from {q.min():.0f} to {q.max():.0f}: are these counts of an "
            "encoder, or degrees?"
        )
        option = (
            f"--units q=counts:TURN{follows} (TURN: counts in one turn of the joint), or q=deg, or q=rad if this "
            "is right"
        )
        return RecordingFinding("scale", "q", recording.names[j], evidence, option, False)
    return None


def find_far(arm: RigidArm, recording: Recording, stated: Corrections) -> RecordingFinding | None:
    """Servos of joints without a range that turn further than a cable lets them: degrees."""
    for j, q in enumerate(recording.position.T):
        least, most = float(np.nanmin(q)), float(np.nanmax(q))
        if np.all(np.isfinite(arm.range[j])) or stated.states("units", f"q_{j + 1}") or most - least < FAR:
            continue
        evidence = f"the position goes from {least:.1f} to {most:.1f} rad: are these degrees?"
        option = f"{_degrees(recording)}, or q=rad if this is right"
        return RecordingFinding("scale", "q", arm.names[j], evidence, option, False)
    return None


def _degrees(recording: Recording) -> str:
    """Option for positions, and what follows them, in degrees."""
    beside = (("dq", recording.velocity), ("q_cmd", recording.position_command))
    return "--units q=deg" + "".join(f",{name}=deg" for name, values in beside if values is not None)


def _percent(arm: RigidArm, recording: Recording) -> str:
    """Option for positions in per cent of each joint's range, if they may be: as LeRobot records them by default.

    −100 to 100 about the middle of a range; a gripper, whose range begins near zero, from 0 at its closed end.
    """
    if not np.isfinite(arm.range).all() or np.nanmax(np.abs(recording.position)) > FULL:
        return ""
    low, high = arm.range.T
    one_sided = low > -CLOSED * high
    angles = ";".join(f"{x:.4g}" for x in np.degrees(np.where(one_sided, high - low, 0.5 * (high - low))))
    channels = ["q", *(["q_cmd"] if recording.position_command is not None else [])]
    units = ",".join(f"{channel}=percent:{angles}" for channel in channels)
    ends = [f"{channel}_{j + 1}={low[j]:.4g}" for channel in channels for j in np.flatnonzero(one_sided)]
    zero = f" --zero {','.join(ends)}" if ends else ""
    return (
        f'or for per cent of the ranges, which LeRobot records unless use_degrees is set, --units "{units}"{zero}, or '
    )


def beyond_range(arm: RigidArm, position: Array) -> Mask:
    """Whether each joint leaves the model's range in positions (…, K, n), (…, n)."""
    low, high = arm.range.T + np.array([[-BEYOND_RANGE], [BEYOND_RANGE]])
    return np.asarray((np.nanmin(position, axis=-2) <= low) | (np.nanmax(position, axis=-2) >= high))


def find_beyond_range(arm: RigidArm, recording: Recording, stated: Corrections) -> RecordingFinding | None:
    """A joint that leaves the model's range, unless the user stated sign, zero, unit or order of its positions."""
    for j in np.flatnonzero(beyond_range(arm, recording.position)).tolist():
        (low, high), q, column = arm.range[j], recording.position[:, j], f"q_{j + 1}"
        least, most = float(np.nanmin(q)), float(np.nanmax(q))
        if stated.joints or stated.order or any(stated.states(k, column) for k in ("sign", "zero", "units")):
            continue
        evidence = (
            f"the recorded position goes from {least:.2f} to {most:.2f} rad, but the joint of the model can "
            f"only go from {low:.2f} to {high:.2f} rad: does the recording have another zero, sign or unit, "
            "or is this another joint?"
        )
        option = (
            f"--zero {column}=ANGLE, --sign {column}=-1 or --map, or --zero {column}=0 if the range of the "
            "model is wrong"
        )
        if most - least > 2.0 * np.pi:
            option = f"{_degrees(recording)}, {_percent(arm, recording)}{option}"
        return RecordingFinding("zero", "q", arm.names[j], evidence, option, False)
    return None


# ---- from row to row

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


def find_jumps(recording: Recording, stated: Corrections) -> RecordingFinding | None:
    """A place at which a position jumps: pieces put together, or rows that are missing while the clock goes on."""
    if "t" in stated.clock:
        return None
    for j, q in enumerate(recording.position.T):
        jumps = np.abs(_jumps(recording.t, q))
        row = int(jumps.argmax())
        if jumps[row] == 0.0:
            continue
        evidence = (
            f"the position jumps by {jumps[row]:.2f} rad from one row to the next at t = "
            f"{recording.t[row + 1]:.2f} s: {TOGETHER}"
        )
        return RecordingFinding("dropped", "q", recording.names[j], evidence, SETTLED, False)
    return None


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


def find_seam(recording: Recording, stated: Corrections) -> RecordingFinding | None:
    """A row after which several joints go on from elsewhere and at another velocity: pieces whose ends are near."""
    if "t" in stated.clock or recording.velocity is None or recording.t.size < 10 * NEAR:
        return None
    t, time = recording.t, np.diff(recording.t)[:, None]
    q, v = (at_times(t, t, values) for values in (recording.position, recording.velocity))
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
        return None
    evidence = (
        f"this joint and {', '.join(joints[1:])} move farther than their velocities allow, and their "
        f"velocities jump as well, at t = {t[row + 3]:.2f} s: {TOGETHER}"
    )
    return RecordingFinding("dropped", "q", joints[0], evidence, SETTLED, False)


def _over_the_rest(size: Array) -> Array:
    """Values over the largest that is not near their own largest, by column (K, n); 0 in columns of zeros."""
    far = np.abs(np.arange(len(size))[:, None] - size.argmax(axis=0)) > NEAR
    rest = np.where(far, size, 0.0).max(axis=0)
    return np.where(rest > 1e-9, size / np.maximum(rest, 1e-9), 0.0)
