"""Floats an arm on the bus: sensors compared with the model, torque control, position control again at the end."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from armlink.canopen.cia402 import Mode
from armlink.errors import ArmlinkError, Refused
from armlink.link.types import Command, Sample
from armlink.loop.driver import ArmDriver
from calib.arm.drive_limits import Limits
from calib.arm.kinematics import gcomp_arm
from calib.floating.controller import FloatConfig, FloatControl
from calib.records.records import CalibrationRecord
from gcomp.arrays import Array

HOLD_SECONDS = 0.5
"""Position control before and after [s]; before, the sensors are averaged and compared with the model."""
AGREEMENT = 0.1
"""Largest difference between sensor and model, as a share of rated torque; beyond it the model is not that of this arm
as it is now. A calibration leaves well below a hundredth (`ObserverConfig.initial_gain_std`)."""


@dataclass(frozen=True)
class Floated:
    """Summary of one float."""

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
    config: FloatConfig | None = None,
    reflect: Callable[[Sample], Array] | None = None,
    on_sample: Callable[[Sample, Array], None] | None = None,
) -> Floated:
    """Float for `seconds` or until KeyboardInterrupt; in either case the joints then hold their positions.

    The link must be enabled; beta (2n,) [kg·m]. `reflect` returns torque (n,) [N·m] to add, for example of a peer's
    arm; `on_sample` sees every sample and the torque commanded (n,) [N·m]. Raises BusFault, and Refused if sensors and
    model disagree.
    """
    described, limits = gcomp_arm(arm), Limits.of(arm)
    given = (
        ()
        if calibration is None
        else (calibration.values("position_gain", 1.0), calibration.values("position_offset", 0.0))
    )
    control = FloatControl(described, beta, limits.rated, limits.speed, link.period, config, *given)
    run = _Run(link, control, reflect, on_sample)
    run.compare(limits.rated)
    try:
        while run.cycles * link.period < seconds:
            run.cycle()
    except KeyboardInterrupt:
        with contextlib.suppress(ArmlinkError):  # interrupted within a cycle, the link holds in quick stop already
            run.hold()
        raise
    run.hold()
    return run.result()


class _Run:
    """One float under way."""

    def __init__(
        self,
        link: ArmDriver,
        control: FloatControl,
        reflect: Callable[[Sample], Array] | None,
        on_sample: Callable[[Sample, Array], None] | None,
    ) -> None:
        self._link, self._control, self._reflect, self._on_sample = link, control, reflect, on_sample
        self._sample = link.cycle(Command.hold(link.position_sent))
        self._position = self._sample.position.copy()
        self.cycles = 0
        self._largest, self._fastest = np.zeros(link.n), np.zeros(link.n)
        self._low, self._high = np.full(link.n, np.inf), np.full(link.n, -np.inf)

    def compare(self, rated: Array) -> None:
        """Hold, and compare sensors with the model; raises Refused naming the joint that differs most."""
        readings = []
        for _ in range(round(HOLD_SECONDS / self._link.period)):
            self._sample = self._link.cycle(Command.hold(self._link.position_sent))
            np.copyto(self._position, self._sample.position, where=np.isfinite(self._sample.position))
            readings.append(self._sample.torque)
        sensor = np.nanmean(np.array(readings), axis=0)
        model = self._control.gravity(self._position)
        away = np.abs(sensor - model)
        worst = int(np.nanargmax(away / rated))
        if not away[worst] <= AGREEMENT * rated[worst]:
            raise Refused(
                f"{self._link.names[worst]}: its sensor reads {sensor[worst]:.2f} N·m, the gravity model says"
                f" {model[worst]:.2f}; at most {AGREEMENT * rated[worst]:.2f} apart is safe to float with: is a load"
                " on the arm, a joint on its stop, or the calibration not written (armlink calibrate --apply)?"
            )

    def cycle(self) -> None:
        """One cycle of torque control."""
        link = self._link
        np.copyto(self._position, self._sample.position, where=np.isfinite(self._sample.position))
        torque = self._control.torque(self._position)
        if self._reflect is not None:
            torque = torque + self._reflect(self._sample)
        command = Command(np.full(link.n, Mode.TORQUE, np.int8), torque, self._position.copy())
        self._sample = link.cycle(command)
        self.cycles += 1
        self._largest = np.maximum(self._largest, np.abs(torque))
        self._fastest = np.maximum(self._fastest, np.abs(self._control.speed))
        self._low, self._high = np.minimum(self._low, self._position), np.maximum(self._high, self._position)
        if self._on_sample is not None:
            self._on_sample(self._sample, torque)

    def hold(self) -> None:
        """Position control at the present positions."""
        link, here = self._link, self._position.copy()
        for _ in range(round(HOLD_SECONDS / link.period)):
            link.cycle(Command.hold(here))

    def result(self) -> Floated:
        """Summary."""
        seconds = self.cycles * self._link.period
        return Floated(seconds, self.cycles, self._largest, self._fastest, self._high - self._low)
