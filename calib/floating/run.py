"""Floats an arm on the bus: gravity compensation, sensors compared with the model, position control at the end.

The identified torque is fed forward, so that the arm stays where a hand leaves it (Ma & Hollerbach, Figure 1). Three
terms are added to gravity: damping, steep near the speed limit; soft ends near the stops; and at rest a small detent,
which holds the arm against the model's error.
"""

import contextlib
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from armlink.drives.orders import Mode
from armlink.errors import ArmlinkError, Refused
from armlink.link.types import Command, Sample
from armlink.loop.open import ArmDriver
from calib.arm.kinematics import DriveLimits, gcomp_arm
from calib.records.records import CalibrationRecord
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.gravity.batch import GravityModel


@dataclass(frozen=True)
class FloatConfig:
    """Feel and safety of a floating arm; tests/calib/floating/test_float.py holds the arm to them."""

    speed_time: float = 0.01
    """Time constant of the speed filter [s]: 2.5 cycles at 250 Hz, against the steps of the encoder."""
    damping_share: float = 0.02
    """Damping torque at the largest speed, as a share of rated torque."""
    fast_share: float = 0.7
    """Above this share of the largest speed damping grows steeply, so that the speed gate does not have to stop the
    arm."""
    fast_damping: float = 0.5
    """Further damping torque at the largest speed, as a share of rated torque."""
    soft_end: float = 0.12
    """Distance from a stop at which the soft end begins [rad]."""
    soft_share: float = 0.3
    """Torque of the soft end at the stop, as a share of rated torque."""
    detent_share: float = 0.01
    """Largest torque of the detent, as a share of rated torque: a hand overcomes it without noticing."""
    detent_width: float = 0.01
    """Deflection at which the detent reaches its largest torque and begins to follow [rad]."""


class FloatControl:
    """`torque(position)` once per cycle. Positions are readings of the joints' own sensors."""

    def __init__(
        self,
        arm: Arm,
        beta: Array,
        rated: Array,
        max_velocity: Array,
        period: float,
        config: FloatConfig | None = None,
        calibration: CalibrationRecord | None = None,
    ) -> None:
        """beta (2n,) [kg·m]; rated torque (n,) [N·m]; max_velocity (n,) [rad/s]; period of a cycle [s].

        A calibration record converts readings to true angles.
        """
        self.config = config or FloatConfig()
        self._model, self._arm = GravityModel(arm, beta), arm
        self._rated, self._top, self._period = rated, max_velocity, period
        self._gain, self._offset = np.ones(arm.n), np.zeros(arm.n)
        if calibration is not None:
            self._gain = calibration.values("position_gain", 1.0)
            self._offset = calibration.values("position_offset", 0.0)
        self._last: Array | None = None
        self._speed: Array = np.zeros(arm.n)
        self._detent: Array = np.zeros(arm.n)

    def torque(self, position: Array, elapsed: float | None = None) -> Array:
        """Target torque (n,) [N·m] at position readings (n,) [rad], `elapsed` seconds after those before.

        The last reading replaces a missing one (NaN); without a time a period has passed.
        """
        angle = self._gain * position + self._offset
        if self._last is None:
            if np.isnan(angle).any():
                return np.full(angle.size, np.nan)
            self._last, self._detent = angle.copy(), angle.copy()
        angle = np.where(np.isnan(angle), self._last, angle)
        period = self._period if elapsed is None else max(elapsed, self._period / 2)
        share = min(period / self.config.speed_time, 1.0)
        self._speed += share * ((angle - self._last) / period - self._speed)
        self._last = angle
        gravity: Array = np.asarray(self._model.one(angle))
        return gravity + self._damping() + self._soft_ends(angle) + self._hold(angle)

    def gravity(self, position: Array) -> Array:
        """The model's torque alone (n,) [N·m] at position readings (n,) [rad]."""
        return np.asarray(self._model.one(self._gain * position + self._offset))

    def _damping(self) -> Array:
        config, relative = self.config, self._speed / self._top
        beyond = np.maximum(np.abs(relative) - config.fast_share, 0.0) / (1.0 - config.fast_share)
        return -self._rated * (config.damping_share * relative + config.fast_damping * beyond * np.sign(relative))

    def _soft_ends(self, angle: Array) -> Array:
        """A spring near each stop, damped towards the stop only."""
        config, arm = self.config, self._arm
        width = np.minimum(config.soft_end, (arm.upper - arm.lower) / 6)
        into_lower = np.clip((arm.lower + width - angle) / width, 0.0, 1.0)
        into_upper = np.clip((angle - arm.upper + width) / width, 0.0, 1.0)
        spring = config.soft_share * (into_lower - into_upper)
        inwards = np.where(into_lower > 0, np.minimum(self._speed, 0.0), np.maximum(self._speed, 0.0)) / self._top
        damped = -config.soft_share * np.maximum(into_lower, into_upper) * inwards
        finite = np.isfinite(arm.upper - arm.lower)
        return np.where(finite, self._rated * (spring + damped), 0.0)

    def _hold(self, angle: Array) -> Array:
        """A spring to the rest position, which beyond its largest torque follows the joint, as dry friction does."""
        width = self.config.detent_width
        self._detent = np.clip(self._detent, angle - width, angle + width)
        return self.config.detent_share * self._rated * (self._detent - angle) / width


HOLD_SECONDS = 0.5
"""Position control before and after [s]; before, the sensors are averaged and compared with the model."""
AGREEMENT = 0.1
"""Largest difference between sensor and model, as a share of rated torque; beyond it the model is not that of this arm
as it is now. A calibration leaves well below a hundredth (`calib.observer.config.INITIAL_GAIN_STD`)."""


@dataclass(frozen=True)
class Floated:
    seconds: float
    """Of the link's clock [s]."""
    largest_torque: Array
    """(n,) [N·m]"""
    largest_speed: Array
    """(n,) [rad/s]"""
    moved: Array
    """Range of positions (n,) [rad]."""


def run_float(
    link: ArmDriver,
    arm: ArmFile,
    beta: Array,
    calibration: CalibrationRecord | None = None,
    *,
    seconds: float = float("inf"),
    reflect: Callable[[Sample], Array] | None = None,
    on_sample: Callable[[Sample, Array], None] | None = None,
) -> Floated:
    """Float for `seconds` or until KeyboardInterrupt; in either case the joints then hold their positions.

    The link must be enabled; beta (2n,) [kg·m]. `reflect` returns torque (n,) [N·m] to add, for example of a peer's
    arm; `on_sample` sees every sample and the torque commanded (n,) [N·m]. Raises BusFault, and Refused if sensors and
    model disagree.
    """
    described, limits = gcomp_arm(arm), DriveLimits.of(arm)
    control = FloatControl(described, beta, limits.rated, limits.speed, link.period, calibration=calibration)
    run = _Float(link, control, on_sample)
    run.compare(limits.rated)
    try:
        run.follow(Floating(control, run.position, reflect), seconds)
    except KeyboardInterrupt:
        with contextlib.suppress(ArmlinkError):  # interrupted within a cycle, the link holds in quick stop already
            run.hold()
        raise
    run.hold()
    return run.result()


class Floating:
    """Torque control by the float, in the process that makes the cycles."""

    def __init__(
        self, control: FloatControl, position: Array, reflect: Callable[[Sample], Array] | None = None
    ) -> None:
        """From `position` (n,) [rad] on; `reflect` gives torque (n,) [N·m] to be added, and must be picklable there."""
        self._control, self._position, self._reflect = control, position.copy(), reflect
        self._t: float | None = None

    def command(self, sample: Sample) -> Command:
        """The torque for the newest sample; a missing position counts as the last."""
        np.copyto(self._position, sample.position, where=np.isfinite(sample.position))
        elapsed = None if self._t is None else sample.t - self._t
        self._t = sample.t
        torque = self._control.torque(self._position, elapsed)
        if self._reflect is not None:
            torque = torque + self._reflect(sample)
        return Command(np.full(len(torque), Mode.TORQUE, np.int8), torque, self._position.copy())


class _Float:
    def __init__(
        self, link: ArmDriver, control: FloatControl, on_sample: Callable[[Sample, Array], None] | None
    ) -> None:
        self._link, self._control, self._on_sample = link, control, on_sample
        self._hold = Command.hold(link.position_sent)
        link.catch_up()
        self._sample = link.cycle(self._hold)
        self.position = self._sample.position.copy()
        self._seconds = 0.0
        self._largest, self._fastest = np.zeros(link.n), np.zeros(link.n)
        self._low, self._high = np.full(link.n, np.inf), np.full(link.n, -np.inf)

    def compare(self, rated: Array) -> None:
        """Hold, and compare sensors with the model; raises Refused naming the joint that differs most."""
        readings = []
        for _ in range(round(HOLD_SECONDS / self._link.period)):
            self._sample = self._link.cycle(self._hold)
            np.copyto(self.position, self._sample.position, where=np.isfinite(self._sample.position))
            readings.append(self._sample.torque)
        sensor = np.nanmean(np.array(readings), axis=0)
        model = self._control.gravity(self.position)
        away = np.abs(sensor - model)
        worst = int(np.nanargmax(away / rated))
        if not away[worst] <= AGREEMENT * rated[worst]:
            raise Refused(
                f"{self._link.names[worst]}: its sensor reads {sensor[worst]:.2f} N·m, but the gravity model "
                f"gives {model[worst]:.2f} N·m; floating is safe only if the two differ by less than "
                f"{AGREEMENT * rated[worst]:.2f} N·m: is a load on the arm, is a joint on its stop, or was "
                "the calibration not written to the drives?"
            )

    def follow(self, floating: Floating, seconds: float) -> None:
        """Float for this long; see each sample."""
        link, begin = self._link, self._sample.t
        with closing(link.run(floating)) as samples:
            for sample in samples:
                np.copyto(self.position, sample.position, where=np.isfinite(sample.position))
                torque = link.torque_sent
                self._seconds = sample.t - begin
                self._largest = np.maximum(self._largest, np.abs(torque))
                self._fastest = np.fmax(self._fastest, np.abs(sample.velocity))
                self._low, self._high = np.minimum(self._low, self.position), np.maximum(self._high, self.position)
                if self._on_sample is not None:
                    self._on_sample(sample, torque)
                if self._seconds >= seconds:
                    return

    def hold(self) -> None:
        here = Command.hold(self.position)
        for _ in range(round(HOLD_SECONDS / self._link.period)):
            self._link.cycle(here)

    def result(self) -> Floated:
        return Floated(self._seconds, self._largest, self._fastest, self._high - self._low)
