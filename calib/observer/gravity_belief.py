"""What is believed of the gravity model: β and its covariance, tuned to the sensors as they were installed."""

import numpy as np

from calib.records.records import Array
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.gravity.torque import gravity_regressor, gravity_stiffness


class ModelBelief:
    """β ~ N(β̂, F Fᵀ). Rows known to be without drift narrow it: from then on drift is measured against them.

    A scale error common to calibration and gravity model, which no later observation could see, drops out this way.
    """

    def __init__(self, arm: Arm, beta: Array, covariance: Array) -> None:
        """beta (2n,) [kg·m], covariance (2n, 2n) [kg²·m²], zero rows where gravity cannot tell."""
        self.arm = arm
        self.beta: Array = np.array(beta, dtype=float)
        values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
        kept = values > 1e-12 * max(values[-1], 1e-300)
        self.factor: Array = vectors[:, kept] * np.sqrt(values[kept])
        self.mass = 0.0
        """Mass of what was taken for a tool [kg]."""

    def torque(self, q: Array) -> Array:
        """Gravity torque (K, n) [N·m] at poses q (K, n)."""
        torque: Array = gravity_regressor(self.arm, q) @ self.beta
        return torque

    def residual(self, q: Array, torque: Array, position_std: float) -> tuple[Array, Array]:
        """Readings less model (K, n) [N·m], and the columns (K·n, P), with unit prior, of what may be wrong with it."""
        regressor = gravity_regressor(self.arm, q)
        of_model = (regressor @ self.factor).reshape(torque.size, -1)
        of_position = gravity_stiffness(self.arm, self.beta, q).reshape(torque.size, -1) * position_std
        return torque - regressor @ self.beta, np.hstack([of_model, of_position])

    def torque_variance(self, q: Array, position_std: float) -> Array:
        """Variance (n,) [N²·m²] of the model torque at one pose q (n,): diagonal of Y Cov(β) Yᵀ + H Σ_q Hᵀ."""
        spread = gravity_regressor(self.arm, q) @ self.factor
        stiffness = gravity_stiffness(self.arm, self.beta, q) * position_std
        variance: Array = (spread**2).sum(axis=1) + (stiffness**2).sum(axis=1)
        return variance

    def carry(self, values: Array, covariance: Array) -> None:
        """From now on the arm carries this: mass and mass times place (4,) as a payload's verdict has them."""
        at_origin, by_point = payload_columns(self.arm)
        columns = np.column_stack([at_origin, by_point])
        self.beta = self.beta + columns @ values
        self.factor = np.hstack([self.factor, columns @ np.linalg.cholesky(covariance)])
        self.mass += float(values[0])

    def learn(self, q: Array, torque: Array, sigma: Array) -> None:
        """Take over rows (K, n) without drift; sigma (n,) [N·m] is the standard deviation of one."""
        regressor = gravity_regressor(self.arm, q)
        residual = ((torque - regressor @ self.beta) / sigma).ravel()
        design = ((regressor @ self.factor) / sigma[:, None]).reshape(residual.size, -1)
        information = np.eye(design.shape[1]) + design.T @ design
        root = np.linalg.cholesky(np.linalg.inv(information))
        self.beta = self.beta + self.factor @ np.linalg.solve(information, design.T @ residual)
        self.factor = self.factor @ root
