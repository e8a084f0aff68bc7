"""The model of external torque of an arm: from its records, or from a model file alone, and its own work.

Before any work is seen the arm is believed to be as these say, and to lack what sound arms lack.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlink.errors import BadInput
from armlink.recording.recording import TORQUE_CHANNELS, Recording
from calib.arm.kinematics import StatedModel
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.arm.arm import Arm
from gcomp.arm.load import bar_inertials
from gcomp.arm.mass_moments import base_parameters
from gcomp.arrays import Array
from gcomp.external.external_model import ROWS_RATE, ArmPrior, ExternalModel, from_records, learn
from gcomp.external.filtered_rows import JOINT_COLUMNS, WAVES, Samples
from gcomp.external.rigid_motion import LINK_PARAMETERS, gravity_split
from gcomp.identify.motor_model import MotorDoubt

LEAST_MASS = 0.02
"""Of the arm's mass: what a link that the model leaves out may have."""
LEAST_REACH = 0.05
"""Distance of a link's mass from its axis, at least [m]."""
MASS_DOUBT, PLACE_DOUBT = 0.2, 0.3
"""Standard deviations of a model's masses, as a share, and of centres and radii of gyration, as a share of a link's
length; a choice, which a baseline corrects."""


_MOTOR = MotorDoubt()


@dataclass(frozen=True)
class JointDoubt:
    """Standard deviations of a joint's own parameters; torques as shares of the joint's scale, the others per SI."""

    offset: float
    coulomb: float
    load: float
    viscous: float
    rotor: float
    gain: float
    waves: float
    noise: float

    def std(self, scale: Array) -> Array:
        """(n, C) as in `gcomp.external.filtered_rows`."""
        of = {
            "offset": self.offset * scale,
            "coulomb": self.coulomb * scale,
            "coulomb_wide": 0.5 * self.coulomb * scale,
            "breakaway": 0.3 * self.coulomb * scale,
            "load": self.load + 0.0 * scale,
            "viscous": self.viscous * scale,
            "quadratic": self.viscous * scale,
            "uneven_cos": 0.2 * self.coulomb * scale,
            "uneven_sin": 0.2 * self.coulomb * scale,
            "warm_coulomb": 0.02 * self.coulomb * scale,
            "warm_viscous": 0.02 * self.viscous * scale,
            "warm_offset": 1e-3 * self.offset * scale,
            "warm_gain": _MOTOR.warming + 0.0 * scale,
            "rotor": self.rotor * scale,
            "gain": self.gain + 0.0 * scale,
        }
        own = np.stack([of[name] for name in JOINT_COLUMNS], axis=-1)
        return np.hstack([own, np.repeat(self.waves * scale[:, None], WAVES, axis=1)])


MOTOR = JointDoubt(
    _MOTOR.offset_share, _MOTOR.coulomb_share, _MOTOR.load, 5 * _MOTOR.viscous_share, 0.05, 0.15, 0.02, 0.03
)
"""Torque that is a motor current, as of a fit of creeping joints; rotors take up to a twentieth of rated torque per
rad/s²."""
LINK = JointDoubt(0.03, 0.03, 0.02, 0.02, 0.002, 0.05, 0.01, 0.01)
"""Torque of a sensor beyond the transmission: bearings, seals and cables alone rub."""


def prior_of_model(arm: Arm, links: Array, doubt: JointDoubt, scale: Array) -> ArmPrior:
    """Of inertials (n, 10) in bar frames that nothing has confirmed."""
    n = arm.n
    mass = np.maximum(links[:, 0], LEAST_MASS * links[:, 0].sum())
    reach = np.maximum(np.linalg.norm(arm.span, axis=1), LEAST_REACH)
    std = np.empty((n, LINK_PARAMETERS))
    std[:, 0] = MASS_DOUBT * mass
    std[:, 1:4] = (PLACE_DOUBT * mass * reach)[:, None]
    std[:, 4:] = (PLACE_DOUBT * mass * reach**2)[:, None]
    back = np.linalg.inv(gravity_split(arm)) * std.ravel()
    joints_std = doubt.std(scale)
    return ArmPrior(links, back @ back.T, np.zeros_like(joints_std), joints_std, doubt.noise * scale)


def with_gravity(prior: ArmPrior, arm: Arm, gravity: GravityRecord, beta: Array) -> ArmPrior:
    """With a record's mass moments in place of those of the links, `beta` (2 n,)."""
    n = arm.n
    links, covariance = prior.links.copy(), prior.covariance.copy()
    links[:, 1:3] += (np.array(gravity.beta) - beta).reshape(n, 2)
    covariance[: 2 * n] = covariance[:, : 2 * n] = 0.0
    covariance[: 2 * n, : 2 * n] = np.array(gravity.covariance)
    return replace(prior, links=links, covariance=covariance)


def with_calibration(prior: ArmPrior, calibration: CalibrationRecord) -> ArmPrior:
    """With a record's friction, and how sure it is of gains and offsets."""
    mean, std, noise = prior.joints.copy(), prior.joints_std.copy(), prior.noise.copy()
    at = {name: k for k, name in enumerate(JOINT_COLUMNS)}
    gain, offset = calibration.std("gain"), calibration.std("offset")
    level = calibration.discrepancy("level")
    for j, joint in enumerate(calibration.joints):
        size = abs(joint.gain or 1.0)
        if np.isfinite(gain[j]):
            std[j, at["gain"]] = gain[j] / size
        if np.isfinite(offset[j]):
            std[j, at["offset"]] = offset[j] / size
        if joint.residual_std is not None:
            noise[j] = joint.residual_std / size
        if level[j] > 0.0:
            std[j, len(at) :] = level[j]
        if joint.motor is not None:
            for name in ("coulomb", "load", "viscous"):
                mean[j, at[name]], std[j, at[name]] = getattr(joint.motor, name)
    return replace(prior, joints=mean, joints_std=std, noise=noise)


FASTEST = 250.0
"""Samples a second at most [Hz]: ten a row."""
LONGEST_GAP = 0.3
"""Between two rows of a recording [s]; a longer one parts it in two."""
SHORTEST = 1.0
"""Of a part [s] that counts."""


def averaged_samples(t: Array, rate: float) -> int:
    """How many samples at times (K,) [s] go into a value at `rate` [Hz]: all of its period, to the 2 % that clocks are
    apart."""
    return max(1, int(1.02 / (rate * float(np.median(np.diff(t))))))


def rate_of(recordings: Sequence[Recording]) -> float:
    """The rate at which all of them are sampled [Hz], a multiple of the rows' rate. Raises BadInput if too slow."""
    slowest = min(1.0 / float(np.median(np.diff(each.t))) for each in recordings)
    if slowest < 0.8 * ROWS_RATE:
        raise BadInput(f"the slowest recording has {slowest:.1f} rows a second, expected at least {ROWS_RATE:g}")
    return ROWS_RATE * max(1, round(min(slowest, FASTEST) / ROWS_RATE))


def even_samples(
    recording: Recording, channel: str, rate: float, warm: Array | None = None
) -> list[tuple[Array, Samples]]:
    """Times [s] and samples of each part without a gap; `warm` (n,) [°C] is the temperature that counts as none."""
    torque = getattr(recording, channel)
    known = np.isfinite(recording.position).all(1) & np.isfinite(torque).all(1)
    t = recording.t[known]
    velocity = recording.velocity
    if velocity is None or not np.isfinite(velocity[known]).all():
        velocity = None
    parts, cuts = [], np.flatnonzero(np.diff(t) > LONGEST_GAP) + 1
    for index in np.split(np.arange(len(t)), cuts):
        if len(index) < 2 or t[index[-1]] - t[index[0]] < SHORTEST:
            continue
        even = np.arange(t[index[0]], t[index[-1]], 1.0 / rate)
        q = _resampled(even, t[index], recording.position[known][index], rate)
        v = np.gradient(q, 1.0 / rate, axis=0)
        if velocity is not None:
            v = _resampled(even, t[index], velocity[known][index], rate)
        warmth = np.zeros_like(q)
        if warm is not None and recording.temperature is not None:
            warmth = np.nan_to_num(_resampled(even, t[index], recording.temperature[known][index], rate) - warm)
        parts.append((even, Samples(q, v, _resampled(even, t[index], torque[known][index], rate), warmth)))
    return parts


def _resampled(even: Array, t: Array, values: Array, rate: float) -> Array:
    """Means over a period where the recording is faster, else straight lines between its rows."""
    count = averaged_samples(t, rate)
    if count >= 2:
        kernel = np.ones(count) / count
        pad = np.pad(values, ((count // 2, count - 1 - count // 2), (0, 0)), mode="edge")
        values = np.stack([np.convolve(column, kernel, mode="valid") for column in pad.T], axis=1)
    return np.stack([np.interp(even, t, column) for column in values.T], axis=1)


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
