"""Quasi-direct drives as laboratories buy them: torque constants, zeros, friction and warming drawn from a seed.

Torque is a motor current: what a drive takes for 1 N·m is `1/k` of it. Levels are what makers and users report
(docs/no-torque-sensors.md has the sources); each joint draws its own.
"""

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from armlink.arrays import Array
from sim_bus.effects.state import Imperfections

Pair = tuple[FiniteFloat, FiniteFloat]
NotNegative = Annotated[FiniteFloat, Field(ge=0)]


class QuasiDirect(BaseModel):
    """Ranges from which the hidden truth is drawn (`sim.quasi_direct`)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    seed: Annotated[int, Field(ge=0)] = 0
    """Draws another arm."""
    constant: Pair = (0.65, 1.35)
    """True torque constant as a share of what the drive takes it for (k)."""
    offset: NotNegative = 0.01
    """Largest offset of the current reading, as a share of rated torque."""
    zero: NotNegative = 0.03
    """Standard deviation of the position zeros, cut at two of them [rad]."""
    coulomb: Pair = (0.015, 0.045)
    """Coulomb friction as a share of rated torque."""
    viscous: Pair = (0.008, 0.025)
    """Viscous friction at 1 rad/s as a share of rated torque."""
    load: Pair = (0.0, 0.1)
    """Friction per transmitted torque."""
    uneven: NotNegative = 0.2
    """Change of the Coulomb friction over a turn, as a share of it."""
    asymmetry: NotNegative = 0.1
    """Largest difference of the directions' friction from their mean, as a share of it."""
    cogging: NotNegative = 0.03
    """Amplitude of the ripple as a share of the Coulomb friction."""
    cogging_cycles: Annotated[FiniteFloat, Field(gt=0)] = 20.0
    """Periods of the ripple in a turn of the joint: the gear's teeth."""
    warming: NotNegative = 0.02
    """Loss of the torque constant when warm."""
    heating: NotNegative = 20.0
    """Rise of the motors' temperature [K]."""
    warming_time: Annotated[FiniteFloat, Field(gt=0)] = 900.0
    """Mean time constant of warming up [s]."""

    def gains(self, n: int, seed: int) -> Array:
        """Reading per torque, 1/k (n,)."""
        return np.asarray(1.0 / np.random.default_rng([seed, 51]).uniform(*self.constant, n))

    def offsets(self, rated: Array, seed: int) -> Array:
        """Offsets of the torque reading (n,) [N·m]."""
        shares = np.random.default_rng([seed, 52]).uniform(-self.offset, self.offset, len(rated))
        return np.asarray(shares * rated)

    def zeros(self, n: int, seed: int) -> Array:
        """Errors of the position zeros (n,) [rad]."""
        return np.asarray(self.zero * np.clip(np.random.default_rng([seed, 53]).standard_normal(n), -2.0, 2.0))

    def add_to(self, state: Imperfections, rated: Array, seed: int) -> None:
        """Add friction, cogging and warming to `state`; rated torques (n,) [N·m]."""
        n, random, turn = len(rated), np.random.default_rng([seed, 54]), 2 * np.pi
        coulomb = rated * random.uniform(*self.coulomb, n)
        state.coulomb += coulomb
        state.viscous += rated * random.uniform(*self.viscous, n)
        state.leaning += random.uniform(-self.asymmetry, self.asymmetry, n)
        amplitude = self.uneven * random.uniform(0.5, 1.0, n)
        load, phase = random.uniform(*self.load, n), random.uniform(0, turn, n)
        state.uneven[:] = np.column_stack([amplitude, phase, load, np.zeros(n)])
        cycles = self.cogging_cycles * random.uniform(0.8, 1.2, n)
        state.cogging[:] = np.column_stack([self.cogging * coulomb, cycles, random.uniform(0, turn, n)])
        times = self.warming_time * random.uniform(0.7, 1.3, n)
        state.warm_constant[:] = np.column_stack([np.full(n, self.warming), times, np.full(n, self.heating)])
