"""Friction of the transmission, between motor and torque sensor: it shows on the motor side only.

In motion, with v the joint's velocity and τ the transmitted torque, friction opposes v with
`F(v) = (torque + breakaway·exp(−(v/velocity)²) + coefficient·|τ|) · (1 ± ratio) + damping·|v|`.
At rest it takes whatever value holds the joint, up to F(0): true stiction.
"""

from sim_bus.effects.effect import NOT_NEGATIVE, POSITIVE, Values, adds, effect
from sim_bus.effects.state import Imperfections


def _stribeck(state: Imperfections, joint: int, values: Values) -> None:
    state.breakaway[joint] += values["breakaway"]
    state.stribeck_velocity[joint] = values["velocity"]


EFFECTS = (
    effect("friction.coulomb", adds(lambda state: state.coulomb, "torque"), torque=NOT_NEGATIVE),
    effect("friction.viscous", adds(lambda state: state.viscous, "damping"), damping=NOT_NEGATIVE),
    effect("friction.stribeck", _stribeck, breakaway=NOT_NEGATIVE, velocity=POSITIVE),
    effect("friction.asymmetric", adds(lambda state: state.asymmetry, "ratio")),
    effect("friction.load", adds(lambda state: state.load_friction, "coefficient"), coefficient=NOT_NEGATIVE),
)
