"""General laws: what a gap may be where its cause is none of the library's. They are never named, only compared with.

A law is a smooth function of one quantity (position, velocity, acceleration, load or time: the regimes in which a gap
is looked for) in one channel of one joint, lateness to second order, any rigid body fixed to a link, or gravity that is
other than the model says. A cause that such a law could stand in for is no certain one, for much that the library does
not hold would look the same in this motion.
"""

from typing import ClassVar

import numpy as np

from sim_gap.effects.drive import commanding
from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import Signals


class _Law(Effect):
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    general: ClassVar[bool] = True
    rare: ClassVar[int] = 0
    family: ClassVar[str]
    """Effects of this family that are a case of the law say the same as it."""
    told: ClassVar[str]
    """The law in words."""


class _MotorLaw(_Law):
    """Of the motor side, which only a recording with motor torque or command can tell from the link's."""

    def places(self, layout: Layout) -> range:
        return range(layout.n if layout.motor else 0)


class OfPosition(_Law):
    """A smooth function of a joint's own position, against the model."""

    id = "law.position"
    family = "transmission"
    told = "any torque on the link that varies smoothly with the joint's position"

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return {(layout.against_model, place): _of_position(signals, place)}


class OfPositionAtMotor(_MotorLaw):
    """A smooth function of a joint's own position on the motor side."""

    id = "law.motor_position"
    family = "transmission"
    told = "anything in the drive train that varies smoothly with the joint's position"

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return {(layout.motor_side, place): _of_position(signals, place)}


class OfLoad(_Law):
    """A sensor whose reading is a smooth function of its torque."""

    id = "law.load"
    family = "torque"
    told = "any sensor that is wrong by a constant and in proportion to its torque"

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return layout.sensor_columns(place, _of_load(signals.model[:, place]))


class OfLoadAtMotor(_MotorLaw):
    """A motor side that loses or gains a smooth function of its torque."""

    id = "law.motor_load"
    family = "actuator"
    told = "any drive that is wrong by a constant and in proportion to its torque"

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return {(layout.motor_side, place): _of_load(signals.motor_model[:, place])}


class OfVelocityAtMotor(_Law):
    """A motor side that loses a smooth function of its velocity."""

    id = "law.motor_velocity"
    family = "friction"
    told = "anything in the drive train that varies smoothly with the joint's velocity"

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        v = signals.v[:, place]
        return {(layout.motor_side, place): np.column_stack([v, v * np.abs(v)])}


class OfAccelerationAtMotor(_MotorLaw):
    """A motor side that carries something heavy."""

    id = "law.motor_acceleration"
    family = "actuator"
    told = "anything in the drive train that goes with the joint's acceleration"

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return {(layout.motor_side, place): signals.a[:, place, None]}


class OfTime(_Law):
    """A sensor whose reading wanders with time."""

    id = "law.time"
    family = "torque"
    told = "any sensor whose reading wanders with time"

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return layout.sensor_columns(place, np.column_stack([np.ones_like(signals.t), signals.t]))


class LateReading(_Law):
    """A sensor's reading that is late in whatever manner: two derivatives of its torque."""

    id = "law.late_reading"
    family = "timing"
    told = "any way in which the sensor's reading comes late"

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return layout.sensor_columns(place, _derivatives(signals.smooth_model[:, place], signals.rate))


class LateDrive(_Law):
    """A drive that is late in whatever manner: two derivatives of its command."""

    id = "law.late_drive"
    family = "actuator"
    told = "any way in which the drive comes late"

    def places(self, layout: Layout) -> range:
        return range(layout.n if commanding(layout) else 0)

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        channel = commanding(layout)
        assert channel is not None
        return {(channel, place): _derivatives(signals.reading["tau_cmd"][:, place], signals.rate)}


class Body(_Law):
    """Any rigid body fixed to a link: its ten inertial parameters."""

    id = "law.body"
    family = "link"
    told = "any rigid body fixed to a link"

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        carrying = np.flatnonzero(signals.arm.carries[:, place])
        return {(layout.against_model, int(j)): signals.regressor[:, j, place] for j in carrying}


class Gravity(_Law):
    """Gravity of any size and direction."""

    id = "law.gravity"
    family = "base"
    told = "gravity that comes from elsewhere than in the model"
    whole_arm = True

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return {(layout.against_model, j): signals.gravity_columns[:, j] for j in range(signals.n)}


def _of_position(signals: Signals, joint: int) -> Array:
    q = signals.q[:, joint]
    return np.column_stack([np.ones_like(q), q, np.sin(q), np.cos(q)])


def _of_load(torque: Array) -> Array:
    return np.column_stack([np.ones_like(torque), torque])


def _derivatives(torque: Array, rate: float) -> Array:
    first = np.gradient(torque, 1.0 / rate)
    return np.column_stack([first, np.gradient(first, 1.0 / rate)])


LAWS = {
    law.id: law
    for law in (
        OfPosition(),
        OfPositionAtMotor(),
        OfLoad(),
        OfLoadAtMotor(),
        OfVelocityAtMotor(),
        OfAccelerationAtMotor(),
        OfTime(),
        LateReading(),
        LateDrive(),
        Body(),
        Gravity(),
    )
}
"""All laws by id."""
EFFECTS: tuple[Effect, ...] = tuple(LAWS.values())
