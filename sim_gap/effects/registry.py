"""The library of effects in their inverse form, one module a family, and the general laws beside it.

A law is what a gap may follow if its cause is not in the library. Laws are compared with causes, never reported: a
cause that a law could replace is not certain, for unknown effects could look the same in this motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects import drive, friction, link, position, torque, transmission
from sim_gap.effects.effect import InverseEffect, Plausibility, Shape, Signature
from sim_gap.effects.link import link_rows
from sim_gap.effects.position import position_effect, reading_moves
from sim_gap.residuals.layout import ChannelLayout, Columns
from sim_gap.residuals.preprocess import PreparedSignals


@dataclass(frozen=True)
class Law:
    id: str
    description: str
    signature: Signature
    cases: frozenset[str] = frozenset()
    """Effects at the same place that are a case of the law, and so say the same."""
    with_sensor: frozenset[str] = frozenset()
    without_sensor: frozenset[str] = frozenset()
    """Further ones of an arm that has a torque sensor, and of one that has none, whose offsets are the drive's."""

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
    return link_rows(signals, layout, place, signals.link_regressor(place))


def _gravity(signals: PreparedSignals, layout: ChannelLayout, _place: int, _shape: Shape) -> Columns:
    return {(layout.against_model, j): signals.gravity_columns[:, j] for j in range(signals.n)}


_LAWS = (
    Law(
        "law.position",
        "any torque on the link that is a smooth function of the joint's position",
        Signature.at_link(_smooth_in_position),
        frozenset({"transmission.spring"}),
    ),
    Law(
        "law.motor_position",
        "any loss in the drive train that is a smooth function of the joint's position",
        Signature.at_motor(_smooth_in_position, "motor"),
        without_sensor=frozenset({"transmission.spring"}),
    ),
    Law(
        "law.load",
        "any sensor error that is constant or proportional to the torque",
        Signature.at_sensor(lambda s, joint, _: _linear(s.model[:, joint])),
        frozenset({"torque.offset", "torque.gain"}),
    ),
    Law(
        "law.motor_load",
        "any drive error that is constant or proportional to the torque",
        Signature.at_motor(lambda s, joint, _: _linear(s.motor_model[:, joint]), "motor"),
        frozenset({"actuator.gain"}),
        without_sensor=frozenset({"torque.offset"}),
    ),
    Law(
        "law.motor_velocity",
        "any loss in the drive train that is a smooth function of the joint's velocity",
        Signature.at_motor(_smooth_in_velocity),
        frozenset({"friction.viscous"}),
    ),
    Law(
        "law.motor_acceleration",
        "any torque in the drive train that is proportional to the joint's acceleration",
        Signature.at_motor(lambda s, joint, _: s.a[:, joint], "motor"),
        frozenset({"actuator.rotor_inertia"}),
    ),
    Law(
        "law.time",
        "any sensor error that drifts with time",
        Signature.at_sensor(lambda s, _joint, _shape: _linear(s.t), "any"),
        frozenset({"torque.drift"}),
        with_sensor=frozenset({"torque.offset"}),
    ),
    Law(
        "law.late_reading",
        "any delay or lag of the sensor's reading",
        Signature.at_sensor(lambda s, joint, _: _derivatives(s.smooth_model[:, joint], s.rate), "any"),
    ),
    Law(
        "law.late_drive",
        "any delay or lag of the drive",
        Signature.at_command(lambda s, joint, _: _derivatives(s.reading["tau_cmd"][:, joint], s.rate)),
    ),
    Law(
        "law.position_reading",
        "any error of the position sensor that is constant or proportional to the position",
        position_effect(reading_moves(lambda q: (np.ones_like(q), q, 0 * q, np.ones_like(q), 0 * q, 0 * q))),
        frozenset({"position.offset", "position.gain"}),
    ),
    Law(
        "law.body",
        "any rigid body fixed to a link",
        Signature(_body),
        frozenset({"link.mass_moment", "link.inertia", "link.payload"}),
    ),
    Law(
        "law.gravity",
        "gravity of another direction or size",
        Signature(_gravity, whole_arm=True),
        frozenset({"base.tilt"}),
    ),
)
LAWS = {law.id: law for law in _LAWS}
"""All laws by id."""


FAMILIES = (friction, link, position, torque, transmission, drive)
"""Modules with an `EFFECTS`; effects are searched in this order."""
NOT_DIAGNOSED = {"torque.nonlinearity": "reported only as the general law `law.load`, never as a cause"}
"""Catalogue ids without an inverse form, and why."""
_LIBRARY: dict[str, InverseEffect] = {each.id: each for family in FAMILIES for each in family.EFFECTS}
_EFFECTS = _LIBRARY | {law.id: law.effect for law in LAWS.values()}


def effects() -> dict[str, InverseEffect]:
    return _EFFECTS


def library_without(withheld: Sequence[str]) -> list[str]:
    """Ids of the library's effects less those withheld and those that need one of these."""
    return [name for name, effect in _LIBRARY.items() if not {name, *effect.needs} & {*withheld}]
