"""General laws: what a gap may follow if its cause is not in the library. They are compared with, never reported.

A law is a smooth function of one quantity (position, velocity, acceleration, load or time: the regimes of a gap) in one
channel of one joint, a position that is read with a constant or proportional error, a delay to second order, any rigid
body fixed to a link, or gravity of another direction or size.
A cause that a law could replace is not certain, for unknown effects could look the same in this motion.
"""

from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.effect import InverseEffect, Plausibility, Shape, Signature
from sim_gap.effects.position import position_effect, reading_moves
from sim_gap.residuals.layout import ChannelLayout, Columns
from sim_gap.residuals.preprocess import PreparedSignals


@dataclass(frozen=True)
class Law:
    id: str
    family: str
    """Effects of this family that are a case of the law say the same."""
    description: str
    signature: Signature

    @property
    def effect(self) -> InverseEffect:
        """The law as the search takes it: free of charge, without priors."""
        return InverseEffect(self.id, self.signature, Plausibility(prior_penalty=0))


def _smooth_in_position(s: PreparedSignals, joint: int, _shape: Shape) -> Array:
    q = s.q[:, joint]
    return np.column_stack([np.ones_like(q), q, np.sin(q), np.cos(q)])


def _linear(torque: Array) -> Array:
    return np.column_stack([np.ones_like(torque), torque])


def _derivatives(torque: Array, rate: float) -> Array:
    first = np.gradient(torque, 1.0 / rate)
    return np.column_stack([first, np.gradient(first, 1.0 / rate)])


def _smooth_in_velocity(s: PreparedSignals, joint: int, _shape: Shape) -> Array:
    v = s.v[:, joint]
    return np.column_stack([v, v * np.abs(v)])


def _body(signals: PreparedSignals, layout: ChannelLayout, place: int, _shape: Shape) -> Columns:
    """The ten inertial parameters of a body fixed to a link."""
    carrying = np.flatnonzero(signals.arm.carries[:, place])
    columns = signals.link_regressor(place)
    return {(layout.against_model, int(j)): columns[:, j] for j in carrying}


def _gravity(signals: PreparedSignals, layout: ChannelLayout, _place: int, _shape: Shape) -> Columns:
    return {(layout.against_model, j): signals.gravity_columns[:, j] for j in range(signals.n)}


_LAWS = (
    Law(
        "law.position",
        "transmission",
        "any torque on the link that is a smooth function of the joint's position",
        Signature.at_link(_smooth_in_position),
    ),
    Law(
        "law.motor_position",
        "transmission",
        "any loss in the drive train that is a smooth function of the joint's position",
        Signature.at_motor(_smooth_in_position, "motor"),
    ),
    Law(
        "law.load",
        "torque",
        "any sensor error that is constant or proportional to the torque",
        Signature.at_sensor(lambda s, joint, _: _linear(s.model[:, joint])),
    ),
    Law(
        "law.motor_load",
        "actuator",
        "any drive error that is constant or proportional to the torque",
        Signature.at_motor(lambda s, joint, _: _linear(s.motor_model[:, joint]), "motor"),
    ),
    Law(
        "law.motor_velocity",
        "friction",
        "any loss in the drive train that is a smooth function of the joint's velocity",
        Signature.at_motor(_smooth_in_velocity),
    ),
    Law(
        "law.motor_acceleration",
        "actuator",
        "any torque in the drive train that is proportional to the joint's acceleration",
        Signature.at_motor(lambda s, joint, _: s.a[:, joint], "motor"),
    ),
    Law(
        "law.time",
        "torque",
        "any sensor error that drifts with time",
        Signature.at_sensor(lambda s, _joint, _shape: _linear(s.t), "any"),
    ),
    Law(
        "law.late_reading",
        "timing",
        "any delay or lag of the sensor's reading",
        Signature.at_sensor(lambda s, joint, _: _derivatives(s.smooth_model[:, joint], s.rate), "any"),
    ),
    Law(
        "law.late_drive",
        "actuator",
        "any delay or lag of the drive",
        Signature.at_command(lambda s, joint, _: _derivatives(s.reading["tau_cmd"][:, joint], s.rate)),
    ),
    Law(
        "law.position_reading",
        "position",
        "any error of the position sensor that is constant or proportional to the position",
        position_effect(reading_moves(lambda q: (np.ones_like(q), q, 0 * q, np.ones_like(q), 0 * q, 0 * q))),
    ),
    Law("law.body", "link", "any rigid body fixed to a link", Signature(_body)),
    Law("law.gravity", "base", "gravity of another direction or size", Signature(_gravity, whole_arm=True)),
)
LAWS = {law.id: law for law in _LAWS}
"""All laws by id."""
