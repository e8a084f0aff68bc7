"""The discrepancy and the gravity model as reference rows have shown them (docs/theory.md)."""

import numpy as np

from calib.observer.discrepancy.kernel import Kernel, Points
from calib.observer.discrepancy.level import DiscrepancyLevel
from calib.observer.discrepancy.reference import Rows
from gcomp.arrays import Array


class Posterior:
    """Residuals at other poses as reference rows predict them: mean and covariance, jointly over joints and poses."""

    def __init__(
        self,
        kernel: Kernel,
        level: DiscrepancyLevel,
        noise: Array,
        free: Array,
        thermal: Array,
        rows: Rows,
        points: Points,
        of_model: Array,
    ) -> None:
        """noise (n,) [N·m]: of one row. free (n,) [N·m]: size of an offset or gain's change between two epochs. thermal
        (n,) [N·m]: how far a zero moves as the joint warms by `kernel.WARM`.

        rows, N reference rows at `points`: in later epochs than the first the sensors may have drifted, so that those
        rows tell the discrepancy but for an offset and a gain of their own. of_model: columns (N, n, P) of the model's
        stated uncertainty, with unit prior, shared by all joints.
        """
        self._kernel, self._level, self._thermal, self._points = kernel, level, thermal, points
        shared = of_model.shape[2]
        self._whitener: Array | None = None
        self._mean: Array = np.zeros(shared)
        self._factor: Array = np.eye(shared)
        if not len(rows):
            return
        covariance = self._between(points, points)
        t = points.torque.T
        later = (rows.epoch[:, None] == rows.epoch[None]) & (rows.epoch[:, None] > 0)
        covariance += later * free[:, None, None] ** 2 * (1.0 + t[:, :, None] * t[:, None, :])
        index = np.arange(len(rows))
        covariance[:, index, index] += (noise**2 + level.rough**2)[:, None]
        self._whitener = np.linalg.inv(np.linalg.cholesky(covariance))
        columns = self._whitener @ of_model.swapaxes(0, 1)
        residual = self._whitener @ rows.residual.T[:, :, None]
        flat = columns.reshape(-1, shared)
        information = np.eye(shared) + flat.T @ flat
        self._mean = np.asarray(np.linalg.solve(information, flat.T @ residual.ravel()))
        self._factor = np.linalg.cholesky(np.linalg.inv(information))
        self._columns = columns
        self._left = residual - columns @ self._mean[:, None]

    def predict(self, points: Points, columns: Array) -> tuple[Array, Array, Array]:
        """At K poses with columns (K, n, P): mean (K, n), covariance of each joint (n, K, K), columns (n, K, P).

        The last have unit prior and are shared by the joints.
        """
        at = columns.swapaxes(0, 1)
        covariance = self._between(points, points)
        mean = at @ self._mean
        if self._whitener is not None:
            across = self._between(self._points, points)
            known = self._whitener @ across
            covariance -= known.swapaxes(1, 2) @ known
            mean = mean + (known.swapaxes(1, 2) @ self._left)[:, :, 0]
            at = at - known.swapaxes(1, 2) @ self._columns
        index = np.arange(points.position.shape[0])
        covariance[:, index, index] += (self._level.rough**2)[:, None]
        return mean.T, covariance, at @ self._factor

    def _between(self, a: Points, b: Points) -> Array:
        """Covariance (n, A, B) of the discrepancy and of zeros that follow temperature [N²·m²]."""
        smooth = self._kernel.weighted(self._level.smooth, a, b)
        if a.warmth.any() and b.warmth.any():
            smooth += self._thermal[:, None, None] ** 2 * a.warmth.T[:, :, None] * b.warmth.T[:, None, :]
        return smooth
