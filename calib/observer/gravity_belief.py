"""Belief about the gravity model: parameters and covariance, adapted to the sensors as they were installed."""

from typing import Any

import numpy as np

from calib.observer.saved_values import UNREADABLE
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, as_array
from gcomp.gravity.torque import gravity_regressor, gravity_stiffness


class GravityBelief:
    """β ~ N(β̂, F Fᵀ). Rows known to be free of drift narrow it; from then on drift is measured against them.

    This removes a scale error common to the calibration and the gravity model, which no later observation could show.
    """

    def __init__(self, arm: Arm, beta: Array, covariance: Array) -> None:
        """beta (2n,) [kg·m], covariance (2n, 2n) [kg²·m²], with zero rows for what gravity does not determine."""
        self.arm = arm
        self.beta: Array = np.array(beta, dtype=float)
        values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
        kept = values > 1e-12 * max(values[-1], 1e-300)
        self._factor: Array = vectors[:, kept] * np.sqrt(values[kept])
        self.mass = 0.0
        """Mass of the loads that the model has taken over as tools [kg]."""
        self.learnt = 0
        """Rows that it was adapted to."""

    def torque(self, q: Array) -> Array:
        """Gravity torque (K, n) [N·m] at poses q (K, n)."""
        torque: Array = gravity_regressor(self.arm, q) @ self.beta
        return torque

    def residual(self, q: Array, torque: Array, position_std: float) -> tuple[Array, Array]:
        """Readings less model (K, n) [N·m], and the columns (K·n, P) of the model's possible error, with unit prior.

        q (K, n) [rad], torque readings (K, n) [N·m]; position_std [rad] is that of a position sensor's zero.
        """
        regressor = gravity_regressor(self.arm, q)
        of_model = (regressor @ self._factor).reshape(torque.size, -1)
        of_position = gravity_stiffness(self.arm, self.beta, q).reshape(torque.size, -1) * position_std
        return torque - regressor @ self.beta, np.hstack([of_model, of_position])

    def torque_variance(self, q: Array, position_std: float) -> Array:
        """Variance (n,) [N²·m²] of the model torque at one pose q (n,): diagonal of Y Cov(β) Yᵀ + H Σ_q Hᵀ."""
        spread = gravity_regressor(self.arm, q) @ self._factor
        stiffness = gravity_stiffness(self.arm, self.beta, q) * position_std
        variance: Array = (spread**2).sum(axis=1) + (stiffness**2).sum(axis=1)
        return variance

    def carry(self, values: Array, covariance: Array) -> None:
        """Add a tool: mass [kg] and first moment [kg·m] (4,), covariance (4, 4), as a payload verdict has them."""
        at_origin, by_point = payload_columns(self.arm)
        columns = np.column_stack([at_origin, by_point])
        self.beta = self.beta + columns @ values
        self._factor = np.hstack([self._factor, columns @ np.linalg.cholesky(covariance)])
        self.mass += float(values[0])

    def learn(self, q: Array, torque: Array, sigma: Array) -> None:
        """Adapt to K rows free of drift: q (K, n) [rad], torque (K, n) and its standard deviation (n,) [N·m]."""
        regressor = gravity_regressor(self.arm, q)
        residual = ((torque - regressor @ self.beta) / sigma).ravel()
        design = ((regressor @ self._factor) / sigma[:, None]).reshape(residual.size, -1)
        information = np.eye(design.shape[1]) + design.T @ design
        root = np.linalg.cholesky(np.linalg.inv(information))
        self.beta = self.beta + self._factor @ np.linalg.solve(information, design.T @ residual)
        self._factor = self._factor @ root
        self.learnt += len(q)

    def save(self) -> dict[str, Any]:
        """Parameters, factor of their covariance, tool mass and rows learnt, as JSON values."""
        return {
            "beta": self.beta.tolist(),
            "factor": self._factor.tolist(),
            "mass": self.mass,
            "learnt": self.learnt,
        }

    def restore(self, values: dict[str, Any]) -> bool:
        """Continue from saved values; False, and nothing changed, if they do not fit."""
        size = self.beta.size
        try:
            beta, factor = as_array("beta", values["beta"], (size,)), as_array("factor", values["factor"], (size, None))
            mass, learnt = float(values["mass"]), int(values["learnt"])
        except UNREADABLE:
            return False
        self.beta, self._factor, self.mass, self.learnt = beta, factor, mass, learnt
        return True
