"""The discrepancy: torque that an arm's gravity model lacks, as a random function of its pose (docs/theory.md).

Its covariance between two poses, its size, the reference rows of quiet work that show it, and what they predict."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from calib.observer.saved_values import known
from calib.records.records import CalibrationRecord
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, as_array
from gcomp.gravity.torque import gravity_regressor, gravity_torque

LOCAL_ANGLE = 0.5
"""Correlation length in a joint's own angle and in its neighbours' [rad]: cables, encoder eccentricity and gear errors
have one to four periods a turn."""
WIDE_ANGLE = 1.4
"""Correlation length in all angles at once [rad]: wrong kinematics and sag are products of first harmonics."""
PARTS = ("local", "wide", "torque")
"""Parts whose sizes are learned: by a joint's own and its neighbours' angles, by all angles, and by torque, of the
joint itself (a sensor that is not linear) and of the others (crosstalk)."""
CONSTANT, SLOPE, SIDE = 0.1, 0.1, 0.05
"""Shares in the variance of each part: of an offset and a gain, which a calibration gets wrong by this much where there
is discrepancy, and of the side of approach (hysteresis)."""
WARM = 20.0
"""Rise of temperature over which a zero moves by the size that is expected of it [K]: a joint that has warmed up."""


@dataclass(frozen=True)
class Points:
    """K poses as the kernel sees them."""

    position: Array
    """True angles (K, n) [rad]."""
    torque: Array
    """Gravity torque over its typical size (K, n)."""
    side: Array
    """Sign of each joint's last motion (K, n); 0 if unknown."""
    warmth: Array
    """Temperature above that of the reference (K, n), in units of WARM; 0 if it is not known."""

    @cached_property
    def turned(self) -> Array:
        """Cosine and sine of each joint's angle (n, K, 2)."""
        return np.stack([np.cos(self.position.T), np.sin(self.position.T)], axis=2)


class Kernel:
    """Unit covariance of each joint's discrepancy; its variance is about 1 at a typical pose."""

    def __init__(self, arm: Arm, beta: Array) -> None:
        """beta (2n,) [kg·m] is the gravity model."""
        self._arm, self._beta = arm, beta
        lower, upper = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
        self.poses: Array = np.random.default_rng(0).uniform(lower, upper, (256, arm.n))
        """Random poses over the joint ranges [rad]."""
        typical = gravity_torque(arm, beta, self.poses).std(axis=0)
        self.typical: Array = np.maximum(typical, 1e-3 * max(float(typical.max()), 1e-9))
        """Standard deviation of each joint's gravity torque over the joint ranges (n,) [N·m]; never 0."""

    @cached_property
    def payload_rank(self) -> int:
        """How many of a payload's mass and first moments the arm's levers show, over its whole range."""
        columns = gravity_regressor(self._arm, self.poses) @ np.column_stack(payload_columns(self._arm))
        flat = columns.reshape(-1, columns.shape[2])
        size = np.linalg.norm(flat, axis=0)
        return int(np.linalg.matrix_rank(flat / np.where(size > 1e-9, size, 1.0), tol=1e-6))

    def points(self, position: Array, side: Array, warmer: Array | None = None, torque: Array | None = None) -> Points:
        """Poses (K, n) [rad], sides of approach, temperatures above the reference's (K, n) [K] and gravity torques
        (K, n) [N·m], computed if not given."""
        warmth = np.zeros_like(position) if warmer is None else warmer / WARM
        torque = gravity_torque(self._arm, self._beta, position) if torque is None else torque
        return Points(position, torque / self.typical, side, warmth)

    def between(self, a: Points, b: Points) -> Array:
        """Covariance (parts, n, A, B) between two sets of poses, joint by joint, of each part at size 1."""
        parts, common = self._shapes(a, b)
        return (1.0 - CONSTANT - SLOPE - SIDE) * np.stack(parts) + common

    def weighted(self, smooth: Array, a: Points, b: Points) -> Array:
        """Covariance (n, A, B) between two sets of poses from the sizes of the parts (parts, n) [N·m]."""
        parts, common = self._shapes(a, b)
        square = (smooth**2)[:, :, None, None]
        covariance: Array = square.sum(axis=0) * common
        for size, part in zip((1.0 - CONSTANT - SLOPE - SIDE) * square, parts, strict=True):
            covariance += size * part
        return covariance

    def _shapes(self, a: Points, b: Points) -> tuple[tuple[Array, ...], Array]:
        """(The shape of each part, (n, A, B) each; what all parts have in common, (n, A, B))."""
        n = a.position.shape[1]
        away = 1.0 - a.turned @ b.turned.swapaxes(1, 2)
        near = np.exp(away * (-1 / LOCAL_ANGLE**2))
        beside = np.zeros_like(near)
        beside[:-1] += near[1:]
        beside[1:] += near[:-1]
        neighbours = np.array([(j > 0) + (j < n - 1) for j in range(n)])
        local = near * (1.0 + beside) / (1.0 + neighbours)[:, None, None]
        wide = np.exp(-away.sum(axis=0) / WIDE_ANGLE**2)
        slope = a.torque.T[:, :, None] * b.torque.T[:, None, :]
        crosstalk = (slope.sum(axis=0) - slope) / max(n - 1, 1)
        curve = slope * slope * (1 / 6.0 + slope / 30.0)  # E t⁴ = 3, E t⁶ = 15 of a normal t: each half of the part
        side = a.side.T[:, :, None] * b.side.T[:, None, :]
        common = CONSTANT + SLOPE * slope + SIDE * side
        return (local, np.broadcast_to(wide, local.shape), (crosstalk + curve) / 2), common


SMALLEST = 0.05
"""Smallest level that is told from none, in standard deviations of one row."""
SHARES = np.array([0.4, 0.3, 0.2, 0.1])
"""Shares of the parts (`kernel.PARTS`, then the rough one) in the variance, before the first row."""
SPREAD_SHARES = 0.7
"""Standard deviation of the logarithm of a part, beside that of the whole."""
LEAST_SINGULAR_VALUE = 1e-6
"""Singular value of columns of unit length below which one of them depends on the others."""
STEPS, LONGEST = 6, 0.7
"""Steps of the search by Fisher scoring, and the longest one, in the logarithm of a standard deviation."""
SPREAD_UNKNOWN, SPREAD_KNOWN = 1.2, 0.4
"""Standard deviation of the level's logarithm before the first row: without a calibration's word on it, and at least
with one, since work is not done at the calibration's poses."""


@dataclass(frozen=True)
class DiscrepancyLevel:
    """Standard deviations of each joint's discrepancy [N·m]."""

    smooth: Array
    """Of the parts that are correlated over poses (`kernel.PARTS`, n)."""
    rough: Array
    """Of the part that is another one at each pose (n,)."""
    before: Array
    """Of all together, as expected before the first row (n,)."""
    spread: Array
    """Standard deviation of the logarithm of what was expected (n,)."""
    rows: int = 0
    """Rows that it was learned from."""

    @classmethod
    def none(cls, n: int) -> "DiscrepancyLevel":
        zero = np.zeros(n)
        return cls(np.zeros((len(PARTS), n)), zero, zero, zero + SPREAD_UNKNOWN)

    @classmethod
    def expected(cls, before: Array, spread: Array | None = None) -> "DiscrepancyLevel":
        """Before the first row; spread (n,) if a calibration has measured it."""
        parts = np.sqrt(SHARES)[:, None] * before
        return cls(parts[:-1], parts[-1], before, np.full_like(before, SPREAD_UNKNOWN) if spread is None else spread)

    @classmethod
    def of_record(cls, calibration: CalibrationRecord, otherwise: Array) -> "DiscrepancyLevel":
        """As the record has it, `otherwise` (n,) [N·m] for joints of which it says nothing."""
        level, std = calibration.discrepancy("level"), calibration.discrepancy("level_std")
        said = level > 0
        spread = np.clip(std / np.where(said, level, 1.0), SPREAD_KNOWN, SPREAD_UNKNOWN)
        return cls.expected(np.where(said, level, otherwise), np.where(said, spread, SPREAD_UNKNOWN))

    @property
    def total(self) -> Array:
        """Of all parts together (n,) [N·m]."""
        return np.asarray(np.sqrt((self.smooth**2).sum(axis=0) + self.rough**2))

    @property
    def is_known(self) -> bool:
        """Whether rows or a calibration have told it."""
        return self.rows > 0 or bool((self.spread < SPREAD_UNKNOWN).all())

    def fitted(self, unit: Array, residual: Array, noise: Array, known: Array, free: Array) -> "DiscrepancyLevel":
        """The level of greatest restricted likelihood, given what was expected; by Fisher scoring.

        unit (parts, n, N, N): covariance of the discrepancy's parts at level 1. residual (n, N) [N·m]: readings less
        model at N poses. noise (n,) [N·m]: of one row. known (n, N, P): columns of the model's stated uncertainty, with
        unit prior. free (n, N, p): columns of any size that the level must not take for discrepancy.
        """
        complement, told = _complement(free)
        across = complement.swapaxes(1, 2)
        left, columns = across @ residual[:, :, None], across @ known
        one = np.eye(told.shape[1])
        parts = np.concatenate([across @ unit @ complement, (told[:, :, None] * one)[None]])
        variance = np.where(told, noise[:, None] ** 2, 1.0)  # any where there is nothing
        fixed = columns @ columns.swapaxes(1, 2) + variance[:, :, None] * one
        least = SMALLEST * noise
        expected = np.log(np.maximum(np.sqrt(SHARES)[:, None] * self.before, least))
        weight = 1 / (self.spread**2 + SPREAD_SHARES**2)
        stds = np.maximum(np.vstack([self.smooth, self.rough]), least)
        for _ in range(STEPS):
            each = stds[:, :, None, None] ** 2 * parts
            inverse = np.linalg.inv(each.sum(axis=0) + fixed)
            explained, white = inverse @ each, inverse @ left
            gradient = np.einsum("mjaa->mj", explained) - np.einsum(
                "jao,mjab,jbo->mj", white, each, white, optimize=True
            )
            gradient += weight * (np.log(stds) - expected)
            flat = explained.swapaxes(0, 1).reshape(len(left), len(parts), -1)
            turned = explained.swapaxes(2, 3).swapaxes(0, 1).reshape(len(left), len(parts), -1)
            hessian = 2 * flat @ turned.swapaxes(1, 2) + weight[:, None, None] * np.eye(len(parts))
            step = np.linalg.solve(hessian, gradient.T[:, :, None])[:, :, 0].T
            stds = np.maximum(stds * np.exp(-np.clip(step, -LONGEST, LONGEST)), least)
        return replace(self, smooth=stds[:-1], rough=stds[-1], rows=residual.shape[1])


def _complement(columns: Array) -> tuple[Array, Array]:
    """Orthonormal basis (n, N, N) of what columns (n, N, p) do not span, and which of its vectors are any (n, N).

    The others are zero. Columns that depend on others, as a payload's do at the last joints, span nothing more.
    """
    size = np.linalg.norm(columns, axis=1, keepdims=True)
    vectors, lengths, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0))
    rank = (lengths > LEAST_SINGULAR_VALUE).sum(axis=1)
    told = np.arange(columns.shape[1]) >= rank[:, None]
    return vectors * told[:, None, :], told


EPOCH_ROWS = 40
"""Rows of one epoch after the first: a minute or two, in which a drift of 0.5 % an hour is 0.02 %."""
EPOCHS = 2
"""Later epochs kept, the newest ones. With the first one they are 240 rows, and cost 30 ms to take in."""
ROWS = ("position", "residual", "side", "temperature", "epoch")


@dataclass(frozen=True)
class Rows:
    """N rows: pose [rad], reading less gravity model [N·m], side of approach and temperature [°C], (N, n) each; epoch
    (N,)."""

    position: Array
    residual: Array
    side: Array
    temperature: Array
    epoch: Array

    def __len__(self) -> int:
        return len(self.epoch)

    def __getitem__(self, kept: Any) -> "Rows":
        return Rows(*(getattr(self, name)[kept] for name in ROWS))

    def and_then(self, *more: Array, epoch: int) -> "Rows":
        """The same and more rows of one epoch: position, residual, side and temperature (K, n)."""
        columns = {name: np.vstack([getattr(self, name), column]) for name, column in zip(ROWS[:-1], more, strict=True)}
        return Rows(**columns, epoch=np.append(self.epoch, np.full(len(more[0]), epoch)))


class Reference:
    """The first epoch, which stays and which drift is measured against, and the newest later ones.

    A slow drift cannot pass for discrepancy: the first epoch ends after `most` rows, and later ones tell nothing of a
    gain or an offset (`Posterior`).
    """

    def __init__(self, n: int, most: int) -> None:
        """n joints; `most` rows in the first epoch."""
        self._most = most
        empty = np.empty((0, n))
        self.rows = Rows(empty, empty, empty, empty, np.empty(0, dtype=int))
        """In use."""
        self._pending = self.rows
        self._epoch = 0

    @property
    def is_first(self) -> bool:
        return self._epoch == 0

    @property
    def temperature(self) -> Array:
        """That the zeros are measured against (n,) [°C]: of the first row; NaN if it was not told."""
        return self.rows.temperature[0] if len(self.rows) else np.full(self.rows.position.shape[1], np.nan)

    def add(self, *more: Array) -> bool:
        """Take rows: position, residual, side and temperature (K, n); whether `rows` is another now."""
        if self.is_first:
            self.rows = self.rows.and_then(*more, epoch=0)
            self._epoch = int(len(self.rows) >= self._most)
            return True
        self._pending = self._pending.and_then(*more, epoch=self._epoch)
        if len(self._pending) < EPOCH_ROWS:
            return False
        kept = self.rows[(self.rows.epoch == 0) | (self.rows.epoch > self._epoch - EPOCHS)]
        new = self._pending
        self.rows = kept.and_then(new.position, new.residual, new.side, new.temperature, epoch=self._epoch)
        self._pending, self._epoch = new[:0], self._epoch + 1
        return True

    def close(self) -> None:
        """A sensor was corrected, or a tool taken over: what follows is another epoch."""
        self._epoch += int(self.is_first or len(self._pending) > 0)
        self._pending = self._pending[:0]

    def forget(self) -> None:
        """Begin again: the discrepancy has changed."""
        self.rows, self._pending, self._epoch = self.rows[:0], self._pending[:0], 0

    def before(self, position: Array) -> Rows:
        """The rows before the one of this pose (n,): all of them if it is not there."""
        same = np.flatnonzero((self.rows.position == position).all(axis=1))
        return self.rows[: same[0]] if len(same) else self.rows

    def save(self) -> dict[str, Any]:
        values = {name: [known(getattr(rows, name)) for rows in (self.rows, self._pending)] for name in ROWS}
        return {"reference": {**values, "open": self._epoch}}

    def restore(self, values: dict[str, Any]) -> None:
        """Older states have none."""
        n = self.rows.position.shape[1]
        if "reference" not in values:
            self.forget()
            return
        saved = values["reference"]
        rows = [_read({name: saved[name][part] for name in ROWS if name in saved}, n) for part in (0, 1)]
        (self.rows, self._pending), self._epoch = rows, int(saved["open"])


def _read(saved: dict[str, Any], n: int) -> Rows:
    """Rows from JSON values; raises one of UNREADABLE."""
    epoch = as_array("epoch", saved["epoch"], (len(saved["epoch"]),)).astype(int)
    position, residual, side = (
        as_array(name, np.reshape(saved[name], (-1, n)), (len(epoch), n)) for name in ("position", "residual", "side")
    )
    untold = np.full((len(epoch), n), np.nan)  # states of before it was kept
    told = np.reshape(np.array(saved.get("temperature", untold), dtype=float), (-1, n))
    return Rows(position, residual, side, as_array("temperature", told, (len(epoch), n), finite=False), epoch)


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
