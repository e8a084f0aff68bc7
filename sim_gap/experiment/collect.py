"""Runs a planned motion on the arm through the link, and records what comes."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from armlink.arrays import Array
from armlink.link.types import Setpoints
from armlink.loop.driver import ArmDriver
from armlink.recording.mcap import RecordingWriter
from calib.motion.trajectory import trajectory
from sim_gap.experiment.excitation import ACCELERATION, PACE


def collect(link: ArmDriver, target: Array, out: Path, progress: Callable[[int, int], None] = lambda k, n: None) -> int:
    """Bring the arm to the first target, follow them all under position control, record each cycle; returns rows.

    The link is started and enabled by the caller, and leaves the joints safe however this ends. A kill loses at most
    the recording's last second. Raises BusFault, Refused.
    """
    section = link.arm.require_link()
    speed = PACE * np.array([joint.max_velocity for joint in section.joints])
    way = trajectory(link.position_sent, target[0], speed, np.full(link.n, ACCELERATION), link.period)
    for _ in link.play(Setpoints.follow(way)):
        pass
    start: float | None = None
    with RecordingWriter(out, link.names) as writer:
        for k, sample in enumerate(link.play(Setpoints.follow(target))):
            start = sample.t if start is None else start
            channels = {
                "position": sample.position,
                "velocity": sample.velocity,
                "torque": sample.torque,
                "motor_torque": sample.motor_torque,
                "torque_command": link.torque_sent,
                "position_command": target[k],
            }
            writer.append(sample.t - start, channels)
            progress(k + 1, len(target))
    return len(target)
