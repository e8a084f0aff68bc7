"""Elasto-plastic friction (Dupont, Hayward, Armstrong, Altpeter 2002): LuGre friction without drift at rest.

f = σ₀ z + σ₁ ż + d v,  ż = v (1 − α(z, v) z/z_ss),  z_ss = g(v, τ)/σ₀ in the direction of v; α is 0 in the elastic
range (|z| below 0.7 z_ss, or v and z of opposite sign), rises smoothly and is 1 in sliding.
g = (coulomb + breakaway·exp(−(v/v_s)²) + load·|τ|)·(1 ± asymmetry).
"""

from collections.abc import Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.cases.true_arm import TrueArm

ELASTIC_SHARE = 0.7
STIFFEST = 0.05
"""σ₀ h²/(inertia) is at most this, for a stable step."""


class Bristles:
    """Friction of many arms at once, (B, width); columns beyond an arm's joints are frictionless."""

    def __init__(self, truths: Sequence[TrueArm], inertia: Array, step: float) -> None:
        """`inertia` (B, width): least inertia that each motor moves [kg·m²]; `step` [s]."""
        width = inertia.shape[1]
        self.coulomb, self.viscous, self.breakaway, self.load = (
            padded([getattr(t, name) for t in truths], width)
            for name in ("coulomb", "viscous", "breakaway", "load_friction")
        )
        self.fade = 1.0 / padded([t.stribeck_velocity for t in truths], width, 1.0) ** 2
        self.asymmetry = padded([t.asymmetry for t in truths], width)
        self.rows = np.array([t.breakaway.any() or t.asymmetry.any() or t.load_friction.any() for t in truths])
        largest = np.maximum(self.coulomb + self.breakaway, 0.05)
        self.bristle = np.minimum(largest / 2e-4, STIFFEST * inertia / step**2)
        self.bristle_damping = 0.3 * np.sqrt(self.bristle * inertia)
        self.step = step
        self.bend = np.zeros_like(inertia)

    def force(self, v: Array, load: Array) -> Array:
        """Friction torque against motor velocities `v` [rad/s] of the first len(v) arms, `load` the torque carried."""
        k = len(v)
        level = self.coulomb[:k]
        if self.rows[:k].any():
            level = level + self.breakaway[:k] * np.exp(-(v**2) * self.fade[:k]) + self.load[:k] * np.abs(load)
            level *= 1.0 + self.asymmetry[:k] * np.sign(v)
        longest = level / self.bristle[:k] + 1e-12
        z = self.bend[:k]
        ratio = z * np.sign(v) / longest
        slip = np.clip((ratio - ELASTIC_SHARE) / (1.0 - ELASTIC_SHARE), 0.0, 1.0)
        slip *= slip * (3.0 - 2.0 * slip)
        rate = v * (1.0 - slip * np.abs(ratio))
        z += self.step * rate
        np.clip(z, -longest, longest, out=z)
        return np.asarray(self.bristle[:k] * z + self.bristle_damping[:k] * rate + self.viscous[:k] * v)


def padded(rows: Sequence[Array], width: int, fill: float = 0.0) -> Array:
    """Rows of different lengths as one array (B, width)."""
    out = np.full((len(rows), width), fill)
    for row, values in zip(out, rows, strict=True):
        row[: len(values)] = values
    return out
