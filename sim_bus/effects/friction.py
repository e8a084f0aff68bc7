"""Friction of the transmission, between motor and torque sensor: it shows on the motor side only.

While the joint moves, with v its velocity and τ the transmitted torque, friction opposes v with
`F(v) = (torque + breakaway·exp(−(v/velocity)²) + coefficient·|τ|) · (1 ± ratio) + damping·|v|`.
At rest it is whatever holds the joint, up to F(0): real stiction.
"""

from collections.abc import Mapping
from typing import Any

from sim_bus.effects.registry import Effect, Parameter
from sim_bus.effects.state import Imperfections


def _coulomb(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.coulomb[joint] += values["torque"]


def _viscous(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.viscous[joint] += values["damping"]


def _stribeck(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.breakaway[joint] += values["breakaway"]
    state.stribeck_velocity[joint] = values["velocity"]


def _asymmetric(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.asymmetry[joint] += values["ratio"]


def _load(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.load_friction[joint] += values["coefficient"]


EFFECTS = (
    Effect("friction.coulomb", (Parameter("torque", "N·m", least=0.0),), _coulomb),
    Effect("friction.viscous", (Parameter("damping", "N·m·s/rad", least=0.0),), _viscous),
    Effect(
        "friction.stribeck",
        (Parameter("breakaway", "N·m", least=0.0), Parameter("velocity", "rad/s", above=0.0)),
        _stribeck,
    ),
    Effect("friction.asymmetric", (Parameter("ratio", "1"),), _asymmetric),
    Effect("friction.load", (Parameter("coefficient", "N·m/(N·m)", least=0.0),), _load),
)
