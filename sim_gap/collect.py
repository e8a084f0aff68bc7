"""Runs a planned motion on the arm through the link, and records what comes."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from armlink.armfile import ArmFile
from armlink.errors import BadInput
from armlink.link import Link
from armlink.recording import load_recording
from armlink.recording_mcap import RecordingWriter
from armlink.sample import Array, Command
from calib.description import gcomp_arm
from calib.motion import trajectory
from sim_gap.motion import ACCELERATION, PACE

FASTER = 1.05
"""A motion may exceed a joint's max_velocity by this much between two rows, for the rounding of a file."""


def load_motion(path: Path, arm: ArmFile) -> Array:
    """Targets (K, n) [rad], one a cycle of the arm's rate, from a file with columns t and q_cmd_i.

    Raises BadInput where the motion does not fit the arm: joints, missing values, range, speed.
    """
    recording = load_recording(path)
    section, described = arm.require_link(), gcomp_arm(arm)
    target = recording.position_command
    if target is None or target.shape[1] != described.n:
        raise BadInput(
            f"{path}: no commanded positions for {described.n} joints: expected columns q_cmd_1 to q_cmd_{described.n}"
        )
    if not np.isfinite(target).all():
        row, joint = np.argwhere(~np.isfinite(target))[0]
        raise BadInput(f"{path}: row {row + 1}: no commanded position of {described.names[joint]}")
    t = np.arange(0.0, recording.t[-1] - recording.t[0], 1.0 / section.rate)
    even = np.column_stack([np.interp(t, recording.t - recording.t[0], column) for column in target.T])
    for joint, name in enumerate(described.names):
        low, high = float(even[:, joint].min()), float(even[:, joint].max())
        if low < described.lower[joint] or high > described.upper[joint]:
            raise BadInput(
                f"{path}: {name} goes from {low:.3f} to {high:.3f} rad, beyond its range {described.lower[joint]:.3f} "
                f"to {described.upper[joint]:.3f}: plan it for this arm (armlink gap plan)"
            )
        fastest, limit = float(np.abs(np.diff(even[:, joint])).max()) * section.rate, section.joints[joint].max_velocity
        if fastest > FASTER * limit:
            raise BadInput(
                f"{path}: {name} turns at {fastest:.3f} rad/s, its max_velocity is {limit:.3f}: slow it down"
            )
    return even


def collect(link: Link, target: Array, out: Path, progress: Callable[[int, int], None] = lambda k, n: None) -> int:
    """Bring the arm to the first target, follow them all under position control, record each cycle; returns rows.

    The link is started and enabled by the caller, and leaves the joints safe however this ends. A kill loses at most
    the recording's last second. Raises BusFault, Refused.
    """
    section = link.arm.require_link()
    speed = PACE * np.array([joint.max_velocity for joint in section.joints])
    for row in trajectory(link.position_sent, target[0], speed, np.full(link.n, ACCELERATION), link.period):
        link.cycle(Command.hold(row))
    start: float | None = None
    with RecordingWriter(out, link.names) as writer:
        for k, row in enumerate(target):
            sample = link.cycle(Command.hold(row))
            start = sample.t if start is None else start
            channels = {
                "position": sample.position,
                "velocity": sample.velocity,
                "torque": sample.torque,
                "motor_torque": sample.motor_torque,
                "torque_command": link.torque_sent,
                "position_command": row,
            }
            writer.append(sample.t - start, channels)
            progress(k + 1, len(target))
    return len(target)
