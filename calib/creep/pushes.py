"""Pushes on the arm beside gravity and friction: contacts, which act in one sweep, and springs, which act in all.

Contact: a push that depends on position shows as a residual that is alike in both directions, large over neighbouring
bins, and that other sweeps of the same joint do not have. Each sweep's residuals, averaged over these, are compared
with the middle of those of all sweeps of that joint; a sweep that stands out is left out of the fit and named with its
worst place.

Spring: a cable under tension pulls in every sweep of its joint, so that no sweep stands out, and mass moments, zeros
and gains take it up. Every arm is therefore fitted once more with a spring at each joint, free within wide bounds.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.creep.model import CreepModel
from calib.creep.rows import CreepRows
from calib.creep.solve import CreepSolution
from gcomp.arm.arm import Arm
from gcomp.arrays import Array

SMOOTH = 3
"""Neighbouring bins that are averaged, those of both directions."""
OUTSTANDING = 6.0
"""A sweep is disturbed if its largest residual is so many times the usual one of its joint; a choice."""
LEAST_PUSH = 0.02
"""Least torque that counts as a disturbance, as a share of rated torque."""
WIDE_SHARE = 0.1
"""Standard deviation beforehand of a spring that is looked for, of rated torque per rad."""
CLEAR = 5.0
"""Standard deviations of a spring that is named."""
LEAST_PULL = 0.03
"""Least pull over the range of the sweeps, as a share of rated torque."""


@dataclass(frozen=True)
class Disturbed:
    """One sweep that was left out."""

    sweep: int
    joint: str
    name: str
    position: float
    """Reading at which the residual was largest [rad]."""
    torque: float
    """That residual [N·m]."""

    def __str__(self) -> str:
        return (
            f"{self.joint}: {self.name}: something pushed by {self.torque:+.2f} N·m at {self.position:.2f} rad: the "
            "arm touched itself or its surroundings, or a cable was under tension; this sweep is left out"
        )


def disturbed_sweeps(arm: Arm, rows: CreepRows, residual: Array, rated: Array) -> list[Disturbed]:
    """The most disturbed sweep of each joint, where there is one; those next to it may follow from its residuals."""
    found = []
    for joint, name in enumerate(arm.names):
        own = np.flatnonzero(rows.joint == joint)
        sweeps = np.unique(rows.sweep[own]).tolist()
        largest = {sweep: _largest(rows, residual, own[rows.sweep[own] == sweep]) for sweep in sweeps}
        if len(largest) < 3:
            continue
        usual = float(np.median([size for _, size in largest.values()]))
        bound = max(OUTSTANDING * usual, LEAST_PUSH * rated[joint])
        sweep, (row, size) = max(largest.items(), key=lambda item: item[1][1])
        if size > bound:
            place = float(rows.position[row, joint])
            found.append(Disturbed(sweep, name, rows.sweeps[sweep], place, float(residual[row])))
    worst = max(found, key=lambda each: abs(each.torque) / rated[arm.names.index(each.joint)], default=None)
    return [] if worst is None else [worst]


def _largest(rows: CreepRows, residual: Array, own: NDArray[np.intp]) -> tuple[int, float]:
    """(Row, size) of the largest residual of one sweep, averaged over neighbouring bins and both directions."""
    each = own[np.argsort(rows.position[own, rows.joint[own]])]
    if each.size < 2 * SMOOTH:
        return int(own[0]), 0.0
    mean = np.convolve(residual[each], np.full(2 * SMOOTH, 0.5 / SMOOTH), mode="valid")
    place = int(np.argmax(np.abs(mean)))
    return int(each[place + SMOOTH]), float(abs(mean[place]))


@dataclass(frozen=True)
class Spring:
    """A pull that grows with position."""

    joint: str
    stiffness: float
    """[N·m/rad]."""

    def __str__(self) -> str:
        return (
            f"{self.joint}: in all its sweeps something pulls by {self.stiffness:+.2f} N·m for each rad of "
            "its position: a cable under tension or a spring; free it and sweep again"
        )


def springs(model: CreepModel, found: CreepSolution, rated: Array) -> tuple[Spring, ...]:
    """Springs in a fit in which they were free."""
    place = model.slices["spring"]
    stiffness, std = found.x[place], np.sqrt(np.diag(found.covariance)[place])
    named = []
    for joint, name in enumerate(model.arm.names):
        own = model.rows.position[model.rows.joint == joint, joint]
        pull = abs(stiffness[joint]) * float(np.ptp(own)) if own.size else 0.0
        if pull > LEAST_PULL * rated[joint] and abs(stiffness[joint]) > CLEAR * std[joint]:
            named.append(Spring(name, float(stiffness[joint])))
    return tuple(named)
