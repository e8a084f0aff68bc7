"""Errors of the transmission between motor and torque sensor.

Ripple is motor torque lost to the gear's teeth, `amplitude·sin(cycles·θ + phase)`; the spring, a cable bundle over the
joint, pulls on the link with `−stiffness·(θ − rest)` and so shows in both channels.
"""

from collections.abc import Mapping
from typing import Any

from sim_bus.effects.registry import Effect, Parameter
from sim_bus.effects.state import Imperfections


def _ripple(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.ripple[joint] = values["amplitude"], values["cycles"], values["phase"]


def _spring(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.spring[joint] = values["stiffness"], values["rest"]


EFFECTS = (
    Effect(
        "transmission.ripple",
        (Parameter("amplitude", "N·m"), Parameter("cycles", "1/rad"), Parameter("phase", "rad", default=0.0)),
        _ripple,
    ),
    Effect("transmission.spring", (Parameter("stiffness", "N·m/rad"), Parameter("rest", "rad", default=0.0)), _spring),
)
