"""The model of external torque of an arm: from its records, or from a model file alone, and its own work."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlink.errors import BadInput
from armlink.recording.recording import TORQUE_CHANNELS, Recording
from calib.arm.stated_model import StatedModel
from calib.external.even_samples import even_samples, rate_of
from calib.external.sound_arm import LINK, MOTOR, prior_of_model, with_calibration, with_gravity
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.arm.load import bar_inertials
from gcomp.arm.mass_moments import base_parameters
from gcomp.arrays import Array
from gcomp.external.external_model import ROWS_RATE, ArmPrior, ExternalModel, from_records, learn
from gcomp.external.filtered_rows import Samples
from gcomp.external.rigid_motion import LINK_PARAMETERS

LARGEST_SHARE = 99
"""Percentile of its torques that is a joint's scale, where no rating is known."""


@dataclass(frozen=True, eq=False)
class ArmRecords:
    """An arm as it is described, and what is recorded of it."""

    stated: StatedModel
    calibration: CalibrationRecord | None = None
    gravity: GravityRecord | None = None

    @property
    def links(self) -> Array:
        """Inertial parameters (n, 10) in the bar frames, of the model file or as mass moments alone would have them."""
        arm = self.stated.arm
        if self.stated.placed is not None:
            return bar_inertials(self.stated.placed)
        if self.gravity is None:
            raise BadInput(
                f"{self.stated.arm.names[0]} …: neither a model file nor a gravity record describes this arm"
            )
        beta = np.array(self.gravity.beta).reshape(arm.n, 2)
        reach = max(float(np.linalg.norm(arm.span, axis=1).sum()), 0.1)
        mass = float(np.abs(beta).max()) / reach / arm.n
        links = np.zeros((arm.n, LINK_PARAMETERS))
        links[:, 0] = mass
        links[:, [4, 7, 9]] = (mass * (np.linalg.norm(arm.span, axis=1) ** 2 + 0.01) / 3.0)[:, None]
        return links

    @property
    def usual_channel(self) -> str:
        """The channel that recordings of its own drives have."""
        joints = () if self.calibration is None else self.calibration.joints
        return "motor_torque" if any(each.motor is not None for each in joints) else "torque"

    def true_angles(self, recording: Recording) -> Recording:
        """Positions are recorded as the sensors read them."""
        if self.calibration is None:
            return recording
        velocity = recording.velocity
        if velocity is not None:
            velocity = velocity * self.calibration.values("position_gain", 1.0)
        return replace(recording, position=self.calibration.angle(recording.position), velocity=velocity)


@dataclass(frozen=True, eq=False)
class ArmListener:
    """Turns recordings of one arm into samples of its model."""

    model: ExternalModel
    records: ArmRecords
    channel: str
    rate: float
    warm: Array | None

    def samples(self, recording: Recording) -> list[tuple[Array, Samples]]:
        return even_samples(self.records.true_angles(recording), self.channel, self.rate, self.warm)


def channel_of(recordings: Sequence[Recording]) -> str:
    """The torque channel nearest to the joint that all recordings have. Raises BadInput without one."""
    for name in TORQUE_CHANNELS:
        if all(getattr(each, name) is not None for each in recordings):
            return name
    raise BadInput("the recordings have no torque channel in common: tau_1 …, tau_motor_1 … or tau_cmd_1 …")


def listener_of(records: ArmRecords, baselines: Sequence[Recording], recordings: Sequence[Recording]) -> ArmListener:
    """Learned from `baselines`; without any, by the records alone. Recordings have the arm's joints in its order."""
    arm = records.stated.arm
    every = [*baselines, *recordings]
    channel = channel_of(every) if every else records.usual_channel
    rate = rate_of(every) if every else ROWS_RATE
    warm = _usual_temperature(baselines or recordings)

    def samples(some: Sequence[Recording]) -> list[Samples]:
        return [part for each in some for _, part in even_samples(records.true_angles(each), channel, rate, warm)]

    runs = samples(baselines)
    scale = _scale(records, runs or samples(recordings))
    prior = prior_of(records, channel, scale)
    model = learn(arm, prior, runs, rate, scale) if runs else from_records(arm, prior, scale)
    return ArmListener(model, records, channel, rate, warm)


def prior_of(records: ArmRecords, channel: str, scale: Array) -> ArmPrior:
    """Before any work of the arm's own; `scale` (n,) [N·m] is that of its joints' torques."""
    arm, links = records.stated.arm, records.links
    prior = prior_of_model(arm, links, LINK if channel == "torque" else MOTOR, scale)
    if records.gravity is not None:
        own = base_parameters(arm, links[:, 0], links[:, 1:4])
        prior = with_gravity(prior, arm, records.gravity, own)
    return prior if records.calibration is None else with_calibration(prior, records.calibration)


def _scale(records: ArmRecords, runs: Sequence[Samples]) -> Array:
    """Torque in which a joint's errors are measured (n,) [N·m]: its rating, or the largest it had."""
    arm_file = records.stated.arm_file
    if arm_file is not None and arm_file.link is not None:
        return np.asarray(arm_file.link.rated_torques)
    if not runs:
        raise BadInput(
            "no recording is long enough to estimate the size of the torques, and no arm file gives rated torques"
        )
    largest = np.percentile(np.abs(np.concatenate([run.torque for run in runs])), LARGEST_SHARE, axis=0)
    return np.asarray(np.maximum(largest, 0.02 * largest.max()))


def _usual_temperature(recordings: Sequence[Recording]) -> Array | None:
    known = [each.temperature for each in recordings if each.temperature is not None]
    if not known:
        return None
    with np.errstate(invalid="ignore"):
        return np.asarray(np.nan_to_num(np.nanmean(np.concatenate(known), axis=0)))
