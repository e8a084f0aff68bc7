"""Floats an arm on the bus: sensors compared with the model, torque control, position control again at the end."""

import contextlib
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from armlink.drives.orders import Mode
from armlink.errors import ArmlinkError, Refused
from armlink.link.types import Command, Sample
from armlink.loop.driver import ArmDriver
from calib.arm.kinematics import DriveLimits, gcomp_arm
from calib.floating.controller import FloatControl
from calib.records.records import CalibrationRecord
from gcomp.arrays import Array

HOLD_SECONDS = 0.5
"""Position control before and after [s]; before, the sensors are averaged and compared with the model."""
AGREEMENT = 0.1
"""Largest difference between sensor and model, as a share of rated torque; beyond it the model is not that of this arm
as it is now. A calibration leaves well below a hundredth (`calib.observer.config.INITIAL_GAIN_STD`)."""


@dataclass(frozen=True)
class Floated:
    seconds: float
    """Of the link's clock [s]."""
    cycles: int
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
    given = (
        ()
        if calibration is None
        else (calibration.values("position_gain", 1.0), calibration.values("position_offset", 0.0))
    )
    control = FloatControl(described, beta, limits.rated, limits.speed, link.period, None, *given)
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
        self._cycles, self._seconds = 0, 0.0
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
                self._cycles, self._seconds = self._cycles + 1, sample.t - begin
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
        return Floated(self._seconds, self._cycles, self._largest, self._fastest, self._high - self._low)
