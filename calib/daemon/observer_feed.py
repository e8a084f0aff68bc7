"""Between bus loop and observer: batches decimated, readings as the record in force has them, what is now."""

import math
from typing import Any

import numpy as np

from armlink.arm_file import ArmFile
from armlink.canopen.cia402 import state_of
from armlink.torque_calibration import UNCALIBRATED, TorqueCalibration, per_joint
from calib.arm.kinematics import gcomp_arm
from calib.daemon.loop.loop_messages import Array, Batch
from calib.daemon.view.api_models import JointNow
from calib.observer.config import ObserverConfig
from calib.observer.events import Event
from calib.observer.observer import Observer
from calib.observer.state import restore_observer, save_observer
from calib.records.records import CalibrationRecord, GravityRecord

NO_STATUS = 0xFFFF
"""Stands for the status word of a joint that has sent none."""
OBSERVED_RATE = 50.0
"""Samples a second that the observer sees, each the mean of those in between: rests last tenths of a second."""


class Watcher:
    """An observer with the records that it measures against."""

    def __init__(
        self, arm: ArmFile, calibration: CalibrationRecord, gravity: GravityRecord, config: ObserverConfig
    ) -> None:
        """Raises Refused where a record is of another arm."""
        section = arm.require_link()
        self.arm, self.gravity, self.calibration = gcomp_arm(arm), gravity.require(arm), calibration.require(arm)
        self.names = self.arm.names
        rated = arm.require_link().rated_torques
        self.observer = Observer.of_records(self.arm, self.calibration, self.gravity, rated, config)
        self._group = max(1, round(section.rate / OBSERVED_RATE))
        self._position_gain = self.calibration.values("position_gain", 1.0)
        self._position_offset = self.calibration.values("position_offset", 0.0)
        self._change = per_joint([UNCALIBRATED] * self.arm.n)
        self._left: tuple[Array, Array, Array] | None = None

    def follow(self, calibration: CalibrationRecord) -> None:
        """Another record follows from the one in force, the controllers hold it: readings are by it from now on."""
        self.calibration = calibration
        self._change = per_joint([UNCALIBRATED] * self.arm.n)

    def controllers_hold(self, held: tuple[tuple[float, float, int], ...] | None) -> list[str]:
        """What the controllers hold (gain, offset, record id); readings are brought to the record in force.

        Returns the joints that hold another pair than the record's; none where it is not known (None).
        """
        if held is None:
            self._change = per_joint([UNCALIBRATED] * self.arm.n)
            return []
        installed = per_joint(TorqueCalibration(gain, offset) for gain, offset, _ in held)
        wanted = self.calibration.torque_calibration(installed)
        same = np.isclose(installed.gain, wanted.gain, rtol=1e-6, atol=0)
        differ = ~(same & np.isclose(installed.offset, wanted.offset, atol=1e-6))
        change = installed.relative_to(wanted)
        self._change = TorqueCalibration(np.where(differ, change.gain, 1.0), np.where(differ, change.offset, 0.0))
        return [name for name, other in zip(self.names, differ, strict=True) if other]

    def decimated(self, batch: Batch) -> tuple[Array, Array, Array]:
        """(t (K,), position (K, n), torque (K, n)) of the batch as the observer takes it, NaN where all is missing."""
        torque = self._change.apply(batch.channels["torque"])
        columns = (batch.t, batch.channels["position"], torque)
        if self._left is not None:
            columns = tuple(np.concatenate(pair) for pair in zip(self._left, columns, strict=True))  # type: ignore[assignment]
        whole = len(columns[0]) // self._group * self._group
        self._left = tuple(column[whole:] for column in columns)  # type: ignore[assignment]
        t, position, torque = (column[:whole] for column in columns)
        n = self.arm.n
        return (
            t.reshape(-1, self._group).mean(axis=1),
            _mean(position.reshape(-1, self._group, n)),
            _mean(torque.reshape(-1, self._group, n)),
        )

    def observe(self, samples: tuple[Array, Array, Array]) -> list[Event]:
        """Give decimated samples to the observer; what it has to say."""
        events: list[Event] = []
        for t, position, torque in zip(*samples, strict=True):
            events += self.observer.handle(float(t), position, torque)
        return events

    def point(self) -> dict[str, list[float]]:
        """Gain, offset [N·m] and their standard deviations, a value a joint: a point of history."""
        estimate = self.observer.estimate()
        return {name: getattr(estimate, name).tolist() for name in ("gain", "gain_std", "offset", "offset_std")}

    def save(self) -> dict[str, Any]:
        """The observer's state as JSON values."""
        return save_observer(self.observer)

    def restore(self, state: dict[str, Any]) -> bool:
        """Go on from a saved state; False where it does not fit."""
        return restore_observer(self.observer, state)

    def model_torque(self, position: Array) -> Array:
        """Gravity torque (n,) [N·m] at position readings (n,); NaN where any reading is missing."""
        angle = self._position_gain * position + self._position_offset
        torque: Array = self.observer.belief.torque(angle[None])[0]
        return torque

    def reading(self, torque: Array) -> Array:
        """A torque reading (n,) by the record in force [N·m]."""
        return self._change.apply(torque)


def joints_now(
    names: tuple[str, ...], batch: Batch | None, watcher: Watcher | None, late: float
) -> tuple[JointNow, ...]:
    """Every joint as of a batch; `late` [s] is how old the batch is. Model torque is None without a watcher."""
    if batch is None:
        return tuple(_joint(name, math.nan, math.nan, math.nan, NO_STATUS, math.inf) for name in names)
    position, torque = batch.channels["position"][-1], batch.channels["torque"][-1]
    model = np.full(len(names), math.nan)
    if watcher is not None:
        torque = watcher.reading(torque)
        if np.isfinite(position).all():
            model = watcher.model_torque(position)
    columns = zip(names, position, torque, model, batch.status.tolist(), batch.age + late, strict=True)
    return tuple(_joint(*column) for column in columns)


def number(value: float) -> float | None:
    """A finite float, or None."""
    value = float(value)
    return value if math.isfinite(value) else None


def _joint(name: str, position: float, torque: float, model: float, status: int, age: float) -> JointNow:
    return JointNow(
        joint=name,
        position=number(position),
        torque=number(torque),
        model_torque=number(model),
        residual=number(torque - model),
        state="unknown" if status == NO_STATUS else state_of(status).value,
        sample_age_s=number(age),
    )


def _mean(groups: Array) -> Array:
    """Mean over axis 1 of what is not missing; NaN where everything is."""
    there = ~np.isnan(groups)
    count = there.sum(axis=1)
    total = np.where(there, groups, 0.0).sum(axis=1)
    mean: Array = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean
