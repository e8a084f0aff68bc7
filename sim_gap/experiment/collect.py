"""Runs a planned motion on the arm through the link and records it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from armlink.arrays import Array
from armlink.link.types import Setpoints
from armlink.loop.driver import ArmDriver
from armlink.recording.mcap import RecordingWriter
from calib.motion.trajectory import trajectory
from sim_gap.experiment.excitation import ACCELERATION, PACE


def collect(
    link: ArmDriver, target: Array, out: str | Path, progress: Callable[[int, int], None] = lambda k, n: None
) -> int:
    """Move to the first target, follow all targets under position control, record each cycle; returns the row count.

    The caller starts and enables the link, which stops the joints safely in every case. A kill loses at most the last
    second of the recording. Raises BusFault, Refused.
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
