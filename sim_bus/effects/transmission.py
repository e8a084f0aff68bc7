"""Errors of the transmission between motor and torque sensor.

Ripple is motor torque lost to the meshing gear, `amplitude·sin(cycles·θ + phase)`; the spring, a cable bundle across
the joint, pulls on the link with `−stiffness·(θ − rest)` and so shows in both channels. Elasticity, backlash (full
width) and coupling are modelled in `sim_bus.physics.transmission`; the position sensor is at the motor.
"""

from sim_bus.effects.effect import NOT_NEGATIVE, POSITIVE, ZERO_BY_DEFAULT, Values, adds, effect
from sim_bus.effects.state import Imperfections


def _ripple(state: Imperfections, joint: int, values: Values) -> None:
    state.ripple[joint] = values["amplitude"], values["cycles"], values["phase"]


def _spring(state: Imperfections, joint: int, values: Values) -> None:
    state.spring[joint] = values["stiffness"], values["rest"]


def _elasticity(state: Imperfections, joint: int, values: Values) -> None:
    """Springs in series: compliances add."""
    state.elasticity[joint] = 1.0 / (1.0 / values["stiffness"] + 1.0 / state.elasticity[joint])


def _coupling(state: Imperfections, joint: int, values: Values) -> None:
    if values["source"] == joint:
        raise ValueError("transmission.coupling: source: expected another joint than the motor's own")
    state.coupling[joint, values["source"]] += values["coefficient"]


EFFECTS = (
    effect("transmission.ripple", _ripple, phase=ZERO_BY_DEFAULT),
    effect("transmission.spring", _spring, rest=ZERO_BY_DEFAULT),
    effect("transmission.elasticity", _elasticity, stiffness=POSITIVE),
    effect("transmission.backlash", adds(lambda state: state.backlash, "width"), width=NOT_NEGATIVE),
    effect("transmission.coupling", _coupling),
)
