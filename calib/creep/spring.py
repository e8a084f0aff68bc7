"""Joints on which something pulls that grows with their position: a cable under tension, or a spring.

Unlike a contact it acts in every sweep of the joint, so that no sweep stands out, and mass moments, zeros and gains
take it up. Every arm is therefore fitted once more with a spring at each joint that is free within wide bounds.
"""

from dataclasses import dataclass

import numpy as np

from calib.creep.model import CreepModel
from calib.creep.solve import Solution
from gcomp.arrays import Array

WIDE_SHARE = 0.1
"""Standard deviation beforehand of a spring that is looked for, of rated torque per rad."""
CLEAR = 5.0
"""Standard deviations of a spring that is named."""
LEAST_SHARE = 0.03
"""Least pull over the range of the sweeps, as a share of rated torque."""


@dataclass(frozen=True)
class Spring:
    """A pull that grows with position."""

    joint: str
    stiffness: float
    """[N·m/rad]."""

    def __str__(self) -> str:
        return (
            f"{self.joint}: something pulls by {self.stiffness:+.2f} N·m/rad of its position in all its sweeps: a cable"
            " under tension or a spring; free it and sweep again"
        )


def springs(model: CreepModel, found: Solution, rated: Array) -> tuple[Spring, ...]:
    """Springs in a fit in which they were free."""
    place = model.slices["spring"]
    stiffness, std = found.x[place], np.sqrt(np.diag(found.covariance)[place])
    named = []
    for joint, name in enumerate(model.arm.names):
        own = model.rows.position[model.rows.joint == joint, joint]
        pull = abs(stiffness[joint]) * float(np.ptp(own)) if own.size else 0.0
        if pull > LEAST_SHARE * rated[joint] and abs(stiffness[joint]) > CLEAR * std[joint]:
            named.append(Spring(name, float(stiffness[joint])))
    return tuple(named)
