"""Which observer suits an arm: one that watches rests, or, where torque is a motor current, one that watches motion."""

from typing import Any, Protocol

from calib.observer.cause_test import DetectionLimits
from calib.observer.config import ObserverConfig
from calib.observer.decision import DriftFinding
from calib.observer.events import Event
from calib.observer.moving.observer import MovingObserver
from calib.observer.observer import Observer
from calib.observer.tracking.sensor_filter import Estimate
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.arm.arm import Arm
from gcomp.arrays import Array


class Observes(Protocol):
    """Interface that both have; see `calib.observer.observer.Observer`."""

    @property
    def rows(self) -> int:
        """Rows used."""
        ...

    @property
    def accepted(self) -> Array:
        """Rows that went into each joint's estimate (n,)."""
        ...

    @property
    def held(self) -> bool:
        """Whether estimates are held until a verdict."""
        ...

    def handle(self, t: float, position: Array, torque: Array, temperature: Array | None = None) -> list[Event]:
        """Take one sample."""
        ...

    def estimate(self) -> Estimate:
        """Gain and offset of every joint."""
        ...

    def limits(self) -> DetectionLimits:
        """Changes that would be noticed now."""
        ...

    def model_torque(self, position: Array) -> Array:
        """Gravity torque as believed (…, n) [N·m]."""
        ...

    def install(self, finding: DriftFinding) -> None:
        """A finding was written."""
        ...

    def save(self) -> dict[str, Any]:
        """State as JSON values."""
        ...

    def restore(self, values: dict[str, Any]) -> bool:
        """Continue from saved values."""
        ...


def observer_of(
    arm: Arm,
    calibration: CalibrationRecord,
    gravity: GravityRecord,
    rated_torque: Array,
    config: ObserverConfig | None = None,
) -> Observes:
    """The observer against these records, whose friction tells that torque is a current; rated_torque (n,) [N·m]."""
    if any(joint.motor is not None for joint in calibration.joints):
        return MovingObserver(arm, calibration, gravity, rated_torque, config)
    return Observer.of_records(arm, calibration, gravity, rated_torque, config)
