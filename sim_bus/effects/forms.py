"""Forms of the catalogue's effects on the simulated arm, by what they act on."""

import numpy as np

from sim_bus.effects.effect import (
    NOT_NEGATIVE,
    POSITIVE,
    ZERO_BY_DEFAULT,
    Domain,
    Values,
    adds,
    effect,
    limits,
    scales,
    sets,
)
from sim_bus.effects.state import Imperfections


def _tilt(state: Imperfections, _joint: int, values: Values) -> None:
    state.tilt += values["angles"]


def _stribeck(state: Imperfections, joint: int, values: Values) -> None:
    state.breakaway[joint] += values["breakaway"]
    state.stribeck_velocity[joint] = values["velocity"]


def _inertia(state: Imperfections, joint: int, values: Values) -> None:
    """The list is xx, yy, zz or xx, yy, zz, xy, xz, yz."""
    added = np.zeros(6)
    added[: len(values["inertia"])] = values["inertia"]
    state.inertia[joint] += added


def _payload(state: Imperfections, _joint: int, values: Values) -> None:
    total = state.payload[0] + values["mass"]
    moment = state.payload[0] * state.payload[1:] + values["mass"] * values["com"]
    state.payload[:] = total, *(moment / total)


def _crosstalk(state: Imperfections, joint: int, values: Values) -> None:
    state.crosstalk[joint, values["source"]] += values["coefficient"]


def _elasticity(state: Imperfections, joint: int, values: Values) -> None:
    """Springs in series: compliances add."""
    state.elasticity[joint] = 1.0 / (1.0 / values["stiffness"] + 1.0 / state.elasticity[joint])


def _coupling(state: Imperfections, joint: int, values: Values) -> None:
    if values["source"] == joint:
        raise ValueError("transmission.coupling: `source` must be another joint than the joint of this motor")
    state.coupling[joint, values["source"]] += values["coefficient"]


ACTUATOR = (
    effect("actuator.gain", scales(lambda state: state.actuator_gain, "gain"), gain=POSITIVE),
    effect("actuator.rotor_inertia", adds(lambda state: state.rotor_inertia, "inertia"), inertia=NOT_NEGATIVE),
    effect("actuator.lag", adds(lambda state: state.actuator_lag, "time"), time=NOT_NEGATIVE),
    effect("actuator.delay", adds(lambda state: state.actuator_delay, "time"), time=NOT_NEGATIVE),
    effect("actuator.saturation", limits(lambda state: state.actuator_saturation, "limit"), limit=NOT_NEGATIVE),
)
"""Errors of motor and drive: the motor torque differs from what the drive reports (6077h)."""

BASE = (effect("base.tilt", _tilt),)
"""A base that is tilted against the drawing: rotated about its own x axis, then about its y axis."""

FRICTION = (
    effect("friction.coulomb", adds(lambda state: state.coulomb, "torque"), torque=NOT_NEGATIVE),
    effect("friction.viscous", adds(lambda state: state.viscous, "damping"), damping=NOT_NEGATIVE),
    effect("friction.stribeck", _stribeck, breakaway=NOT_NEGATIVE, velocity=POSITIVE),
    effect("friction.asymmetric", adds(lambda state: state.asymmetry, "ratio")),
    effect("friction.load", adds(lambda state: state.load_friction, "coefficient"), coefficient=NOT_NEGATIVE),
)
"""Friction of the transmission, between motor and torque sensor: it shows on the motor side only.

In motion, with v the joint's velocity and τ the transmitted torque, friction opposes v with
`F(v) = (torque + breakaway·exp(−(v/velocity)²) + coefficient·|τ|) · (1 ± ratio) + damping·|v|`.
At rest it takes whatever value holds the joint, up to F(0): true stiction.
"""

LINK = (
    effect("link.mass_moment", adds(lambda state: state.mass_moment, "moment")),
    effect("link.inertia", _inertia, inertia=Domain(sizes=(3, 6))),
    effect("link.payload", _payload, mass=POSITIVE),
)
"""Masses that differ from the drawing; all in the bar frame of their link."""

POSITION = (
    effect("position.offset", adds(lambda state: state.position_offset, "offset")),
    effect("position.gain", scales(lambda state: state.position_gain, "gain"), gain=POSITIVE),
    effect(
        "position.eccentricity", sets(lambda state: state.eccentricity, "amplitude", "phase"), phase=ZERO_BY_DEFAULT
    ),
)
"""Errors of the position sensor: `θ = gain·φ + offset + amplitude·sin(φ + phase)`, φ the reading, θ the true angle."""

TIMING = (effect("timing.delay", adds(lambda state: state.torque_delay, "delay"), delay=NOT_NEGATIVE),)

TORQUE = (
    effect("torque.offset", adds(lambda state: state.torque_offset, "offset")),
    effect("torque.gain", scales(lambda state: state.torque_gain, "gain")),
    effect("torque.drift", adds(lambda state: state.torque_drift, "rate")),
    effect("torque.crosstalk", _crosstalk),
    effect("torque.hysteresis", adds(lambda state: state.hysteresis, "width"), width=NOT_NEGATIVE),
    effect("torque.deadband", adds(lambda state: state.deadband, "width"), width=NOT_NEGATIVE),
    effect("torque.saturation", limits(lambda state: state.torque_saturation, "limit"), limit=NOT_NEGATIVE),
)
"""Errors of the joint torque sensor.

In this order: crosstalk mixes the joints' torques; hysteresis (a play of half width `width`), dead band and saturation
distort the signal; then `v = gain·τ + offset + rate·t` on top of the sensor's own gain and offset.
"""

TRANSMISSION = (
    effect(
        "transmission.ripple", sets(lambda state: state.ripple, "amplitude", "cycles", "phase"), phase=ZERO_BY_DEFAULT
    ),
    effect("transmission.spring", sets(lambda state: state.spring, "stiffness", "rest"), rest=ZERO_BY_DEFAULT),
    effect("transmission.elasticity", _elasticity, stiffness=POSITIVE),
    effect("transmission.backlash", adds(lambda state: state.backlash, "width"), width=NOT_NEGATIVE),
    effect("transmission.coupling", _coupling),
)
"""Errors of the transmission between motor and torque sensor.

Ripple is motor torque lost to the meshing gear, `amplitude·sin(cycles·θ + phase)`; the spring, a cable bundle across
the joint, pulls on the link with `−stiffness·(θ − rest)` and so shows in both channels. Elasticity, backlash (full
width) and coupling are modelled in `sim_bus.physics.transmission`; the position sensor is at the motor.
"""

EFFECTS = (*ACTUATOR, *BASE, *FRICTION, *LINK, *POSITION, *TIMING, *TORQUE, *TRANSMISSION)
