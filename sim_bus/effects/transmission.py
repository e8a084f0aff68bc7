"""Errors of the transmission between motor and torque sensor.

Ripple is motor torque lost to the gear's teeth, `amplitude·sin(cycles·θ + phase)`; the spring, a cable bundle over the
joint, pulls on the link with `−stiffness·(θ − rest)` and so shows in both channels. Elasticity, backlash (its full
width) and coupling are those of `sim_bus.physics.transmission`; the position sensor sits at the motor.
"""

from collections.abc import Mapping
from typing import Any

from sim_bus.effects.registry import Effect, Parameter
from sim_bus.effects.state import Imperfections


def _ripple(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.ripple[joint] = values["amplitude"], values["cycles"], values["phase"]


def _spring(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.spring[joint] = values["stiffness"], values["rest"]


def _elasticity(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.elasticity[joint] = 1.0 / (1.0 / values["stiffness"] + 1.0 / state.elasticity[joint])


def _backlash(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.backlash[joint] += values["width"]


def _coupling(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    if values["source"] == joint:
        raise ValueError("transmission.coupling: source: expected another joint than the motor's own")
    state.coupling[joint, values["source"]] += values["coefficient"]


EFFECTS = (
    Effect(
        "transmission.ripple",
        (Parameter("amplitude", "N·m"), Parameter("cycles", "1/rad"), Parameter("phase", "rad", default=0.0)),
        _ripple,
    ),
    Effect("transmission.spring", (Parameter("stiffness", "N·m/rad"), Parameter("rest", "rad", default=0.0)), _spring),
    Effect("transmission.elasticity", (Parameter("stiffness", "N·m/rad", above=0.0),), _elasticity),
    Effect("transmission.backlash", (Parameter("width", "rad", least=0.0),), _backlash),
    Effect(
        "transmission.coupling", (Parameter("coefficient", "1"), Parameter("source", "joint", joint=True)), _coupling
    ),
)
