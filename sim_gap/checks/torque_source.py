"""Torque channels that repeat another one, or that are the law of a drive's gains; gravity that was subtracted."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armlink.recording.corrections import Corrections
from armlink.recording.recording import Recording
from sim_gap.checks.finding import RecordingFinding
from sim_gap.model.rigid_body import RigidArm
from sim_gap.residuals.preprocess import CHANNELS

LAWFUL, STEPS = 0.3, 50
"""Least share of the variance of a command's steps that a law of gains explains (half on OpenArm, where positions,
velocities and targets are rounded on the bus); least number of such steps."""


def with_gravity(arm: RigidArm, recording: Recording, channels: Sequence[str]) -> Recording:
    """The recording with the model's gravity added to these torque channels."""
    still = np.zeros_like(recording.position)
    gravity = arm.torque(recording.position, still, still)
    made = {CHANNELS[channel]: getattr(recording, CHANNELS[channel]) for channel in channels}
    return replace(recording, **{name: values + gravity for name, values in made.items() if values is not None})


def find_same(recording: Recording, stated: Corrections) -> list[RecordingFinding]:
    """A channel taken for a link sensor's that repeats the motors': arms without sensors have one reading of torque."""
    link, motor = recording.torque, recording.motor_torque
    if stated.effort or link is None or motor is None or not np.array_equal(link, motor, equal_nan=True):
        return []
    evidence = (
        "the channel equals tau_motor in every sample, so these drives have only one torque reading, the torque "
        "of their motors"
    )
    return [RecordingFinding("effort_source", "tau", "all", evidence, "--effort-is motor", True)]


def find_gain_command(recording: Recording, stated: Corrections) -> list[RecordingFinding]:
    """Commanded torque that is the law of drives with gains at the row's readings: kp (q_cmd − q) + kd (…) + τ.

    The drive follows the position within its cycle, and the command may be another one already: the law then differs
    from the torque made by kp times the way of half a cycle or more, which is far more than friction's uncertainty.
    """
    command, target, velocity = recording.torque_command, recording.position_command, recording.velocity
    if "tau_cmd" in stated.clock or command is None or target is None or velocity is None:
        return []
    lawful = 0
    for own, error, speed in zip(command.T, (target - recording.position).T, velocity.T, strict=True):
        steps = np.diff(np.stack([own, error, speed]), axis=1)
        steps = steps[:, np.isfinite(steps).all(axis=0)]
        if steps.shape[1] < STEPS or np.ptp(steps[0]) == 0.0 or np.ptp(steps[1]) == 0.0:
            continue
        law = np.linalg.lstsq(steps[1:].T, steps[0], rcond=None)[0]
        lawful += bool(np.var(law @ steps[1:]) > LAWFUL * np.var(steps[0]) and law[0] > 0.0)
    if 2 * lawful <= recording.position.shape[1]:
        return []
    evidence = (
        "the torque was computed as kp (q_cmd − q) from the values of the same row, but the drive computes it "
        "at another time in the cycle, so the channel is left out"
    )
    return [RecordingFinding("clock", "tau_cmd", "all", evidence, "--clock tau_cmd=0 (to keep the channel)", True)]
