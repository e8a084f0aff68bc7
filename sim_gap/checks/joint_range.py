"""Positions that no joint can have: whole numbers, which are counts, and angles beyond the ranges of the model."""

import numpy as np

from armlink.recording.corrections import Corrections
from armlink.recording.recording import Recording
from gcomp.arrays import Array, Mask
from sim_gap.checks.finding import RecordingFinding
from sim_gap.model.rigid_body import RigidArm

BEYOND = 0.2
"""Distance beyond the end of its range from which a joint is not there [rad]; zeros and soft limits differ by less."""
FULL = 100.5
"""Largest position in per cent of a range, with a half for rounding."""
CLOSED = 0.25
"""A range begins near zero if its lower end is no further below than this share of the upper one is above."""
FAR = 20.0
"""Range of a position [rad] from which whole numbers alone are counts, and a servo's turns are likely degrees."""


def find_counts(recording: Recording, stated: Corrections) -> list[RecordingFinding]:
    """Positions of whole numbers alone: counts of encoders, of which the number a turn has to be given."""
    found = []
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
        found.append(RecordingFinding("scale", "q", recording.names[j], evidence, option, False))
    return found


def find_far(arm: RigidArm, recording: Recording, stated: Corrections) -> list[RecordingFinding]:
    """Servos of joints without a range that turn further than a cable lets them: degrees."""
    found = []
    for j, q in enumerate(recording.position.T):
        if (
            np.all(np.isfinite(arm.range[j]))
            or stated.states("units", f"q_{j + 1}")
            or np.nanmax(q) - np.nanmin(q) < FAR
        ):
            continue
        evidence = f"the position goes from {np.nanmin(q):.1f} to {np.nanmax(q):.1f} rad: are these degrees?"
        found.append(
            RecordingFinding(
                "scale", "q", arm.names[j], evidence, f"{_degrees(recording)}, or q=rad if this is right", False
            )
        )
    return found


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
    """Whether each joint leaves the model's range in positions (K, n), (n,)."""
    low, high = arm.range.T
    return np.asarray((np.nanmin(position, axis=0) <= low - BEYOND) | (np.nanmax(position, axis=0) >= high + BEYOND))


def find_beyond_range(arm: RigidArm, recording: Recording, stated: Corrections) -> list[RecordingFinding]:
    """Joints that leave the model's range, unless the user stated sign, zero, unit or order of their positions."""
    found = []
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
        found.append(RecordingFinding("zero", "q", arm.names[j], evidence, option, False))
    return found
