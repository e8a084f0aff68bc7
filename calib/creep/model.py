"""The reading of a creeping joint whose torque is a current, and its derivatives (docs/theory.md, section 11).

    v = g (1 + w·warmth) (τ + (s + a)(F_c + μ|τ|) + s·u(q) + F_v q̇ + c(q) + κ (q − q̄)) + o

τ is the gravity torque of joint i at the angles q + zero − lag·q̇, with the reference mass where it hangs: torque is
read a little later than the position; s is the direction. c is a line of ripple, of a given period; κ a spring's
stiffness, which is 0 unless one is looked for. The product a·u is left out: a millinewton-metre or so, it would be all
that tells a from the offset where torque keeps its sign, and no arm is as exact as that.
"""

import numpy as np

from calib.creep.parameters import HARMONICS, family_slices
from calib.creep.rows import CreepRows
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.gravity.regressor import regressor
from gcomp.gravity.torque import gravity_stiffness


class CreepModel:
    """Readings of given rows for given parameters."""

    def __init__(self, arm: Arm, rows: CreepRows, ripple: Array | None = None) -> None:
        """Prepare for R rows; `ripple` (n,) are its periods in a turn of each joint, 0 where there is none."""
        self.arm, self.rows, self.n = arm, rows, arm.n
        self.slices = family_slices(arm.n)
        self.size = self.slices["rho"].stop
        self._at_origin, self._by_point = payload_columns(arm)
        self._each = np.arange(len(rows))
        own = rows.position[self._each, rows.joint]
        waves = [f(k * own) for k in range(1, HARMONICS + 1) for f in (np.cos, np.sin)]
        self._waves = np.stack(waves, axis=1)
        self.ripple = np.zeros(self.n) if ripple is None else ripple
        cycles = self.ripple[rows.joint]
        self._ripple = np.stack([np.cos(cycles * own), np.sin(cycles * own)], axis=1) * (cycles > 0)[:, None]
        means = [own[rows.joint == joint].mean() if (rows.joint == joint).any() else 0.0 for joint in range(self.n)]
        self._stretch = own - np.array(means)[rows.joint]

    def gravity(self, x: Array) -> Array:
        """Gravity torque of each row's joint (R,) [N·m]."""
        return self._gravity(x)[0]

    def predict(self, x: Array) -> Array:
        """Readings (R,) [N·m] for the parameter vector x."""
        return self._evaluate(x, False)[0]

    def linearised(self, x: Array) -> tuple[Array, Array]:
        """(Readings (R,), derivatives (R, P))."""
        return self._evaluate(x, True)

    def _gravity(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """(Torque (R,), regressor rows (R, 2n), angles (R, n), added mass moments per kilogram (2n,))."""
        rows, at = self.rows, self.slices
        angles = rows.position + x[at["zero"]]
        angles[self._each, rows.joint] -= x[at["lag"]] * rows.velocity
        of_joint = regressor(self.arm, angles)[self._each, rows.joint]
        per_kilogram = self._at_origin + self._by_point @ x[at["rho"]]
        torque = of_joint @ x[at["beta"]] + rows.mass * (of_joint @ per_kilogram)
        return torque, of_joint, angles, per_kilogram

    def _evaluate(self, x: Array, derive: bool) -> tuple[Array, Array]:
        rows, at, j = self.rows, self.slices, self.rows.joint
        torque, of_joint, angles, per_kilogram = self._gravity(x)
        gain, warming = x[at["gain"]][j], x[at["warming"]][j]
        coulomb, load, asymmetry = (x[at[name]][j] for name in ("coulomb", "load", "asymmetry"))
        side, size = rows.side, np.abs(torque)
        uneven = x[at["uneven"]].reshape(self.n, -1)[j]
        ripple = x[at["ripple"]].reshape(self.n, 2)[j]
        level, both = coulomb + load * size, side + asymmetry
        motor = torque + both * level + side * (self._waves * uneven).sum(axis=1)
        motor = motor + (self._ripple * ripple).sum(axis=1)
        motor = motor + x[at["viscous"]][j] * rows.velocity + x[at["spring"]][j] * self._stretch
        scale = 1 + warming * rows.warmth
        predicted: Array = gain * scale * motor + x[at["offset"]][j]
        if not derive:
            return predicted, np.empty((0, 0))
        jacobian = np.zeros((len(rows), self.size))
        each, slope = self._each, gain * scale
        own = {
            "gain": scale * motor,
            "offset": np.ones(len(rows)),
            "coulomb": slope * both,
            "load": slope * both * size,
            "viscous": slope * rows.velocity,
            "asymmetry": slope * level,
            "warming": gain * rows.warmth * motor,
            "spring": slope * self._stretch,
        }
        for family, column in own.items():
            jacobian[each, at[family].start + j] = column
        width = 2 * HARMONICS
        for k in range(width):
            jacobian[each, at["uneven"].start + width * j + k] = slope * side * self._waves[:, k]
        for k in range(2):
            jacobian[each, at["ripple"].start + 2 * j + k] = slope * self._ripple[:, k]
        by_torque = slope * (1 + both * load * np.sign(torque))
        jacobian[:, at["beta"]] = by_torque[:, None] * of_joint
        jacobian[:, at["rho"]] = (by_torque * rows.mass)[:, None] * (of_joint @ self._by_point)
        stiffness = self._stiffness(x, angles, per_kilogram)
        jacobian[:, at["zero"]] = by_torque[:, None] * stiffness
        jacobian[:, at["lag"].start] = -by_torque * stiffness[each, j] * rows.velocity
        return predicted, jacobian

    def _stiffness(self, x: Array, angles: Array, per_kilogram: Array) -> Array:
        """∂τ/∂q (R, n) of each row's joint [N·m/rad]."""
        found = np.empty((len(self.rows), self.n))
        for mass in np.unique(self.rows.mass):
            rows = np.flatnonzero(self.rows.mass == mass)
            beta = x[self.slices["beta"]] + mass * per_kilogram
            found[rows] = gravity_stiffness(self.arm, beta, angles[rows])[np.arange(len(rows)), self.rows.joint[rows]]
        return found
