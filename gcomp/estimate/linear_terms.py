"""Worth of effects: the likelihood of rows that are held out, and a price for each parameter.

All is linear about one point, so that a choice of effects (`choice`) takes no further evaluation of the problem.
"""

from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np

from gcomp.arrays import Array
from gcomp.estimate.problem import EstimationProblem, Index, Linearised
from gcomp.estimate.solve import precision, robust_weight, scale_of

PRICE = 4.0
"""Fall of the negative logarithm of the held-out likelihood that a parameter has to pay for: the best of m useless ones
brings log m of rows that are fitted (risk inflation criterion, Foster and George, Annals of Statistics 22, 1994), and
one less of rows that are held out. A six-joint arm has m = 150: log 150 − 1 = 4.0."""
SIGNIFICANT = 2.0
"""Standard errors from which something is told from chance: 98 % of a normal distribution, one-sided."""
RIDGE = 1e-10
"""Addition to normal equations of columns of unit length, for columns that are nearly alike."""
REWEIGHINGS = 3
"""Fits after which the scale of a channel and the fit that follows from it agree."""
Name = TypeVar("Name", bound=Hashable)


@dataclass(frozen=True)
class Effect(Generic[Name]):
    """Parameters that come together, and what they need beside them."""

    name: Name
    parameters: tuple[int, ...]
    needs: tuple[Name, ...] = ()
    price: float | None = None
    """Price, if it is not that of all its parameters: some may show nothing, and a rare effect costs more."""
    excludes: frozenset[Name] = frozenset()
    """Effects that give way to it: its own other forms, and those whose columns it contains."""
    simpler: tuple[Name, ...] = ()
    """Simpler effects that together could take its place."""


@dataclass(frozen=True, eq=False)
class LinearTerms:
    """Normal equations of a problem about a point, of each channel c and fold f."""

    theta: Array
    acting: tuple[Index, ...]
    squares: tuple[Array, ...]
    """(F, k, k) of each channel."""
    products: tuple[Array, ...]
    """(F, k)."""
    totals: Array
    """Weighted squares of the residuals, (C, F)."""
    counts: Array
    """Independent measurements, (C, F)."""
    variance: Array
    """(C,)."""
    floor: Array
    away: Array
    """Change of a parameter that is not free: its nominal value less that of the point, (K,); NaN where there is
    none."""
    prior: Array
    """Inverse variance of each parameter before any measurement, (K,)."""
    expected: Array
    """Expected change of a parameter that is free, (K,)."""
    low: Array
    high: Array
    """Least and largest change of each parameter, (K,)."""
    _found: dict[frozenset[int], Array] = field(default_factory=dict)
    _fits: dict[frozenset[int], tuple[Index, Array]] = field(default_factory=dict)

    @cached_property
    def _places(self) -> Index:
        """Place of each parameter among those that act on a channel, −1 for the others, (C, K)."""
        out = np.full((len(self.acting), len(self.theta)), -1, np.intp)
        for c, index in enumerate(self.acting):
            out[c, index] = np.arange(len(index))
        return out

    def _inside(self, index: Index) -> Iterator[tuple[int, Index, Index]]:
        """Each channel on which some of these parameters act, which of them do, and their places there."""
        places = self._places[:, index]
        there = places >= 0
        for c in np.flatnonzero(there.any(1) & self.counts.any(1)).tolist():
            yield c, np.flatnonzero(there[c]), places[c, there[c]]

    @cached_property
    def _still(self) -> Array:
        return np.asarray(np.nan_to_num(self.away))

    def _fit(self, free: frozenset[int]) -> tuple[Index, Array]:
        """Free parameters (p,) and their changes without each fold, then from all, (F + 1, p)."""
        if free in self._fits:
            return self._fits[free]
        index = np.array(sorted(free), np.intp)
        folds, size = self.totals.shape[1], len(index)
        gram, side = np.zeros((folds, size, size)), np.zeros((folds, size))
        still = self._still.copy()
        still[index] = 0.0
        moved = np.flatnonzero(still)
        for c, inside, at in self._inside(index):
            own, place = -self.products[c][:, at], self._places[c]
            if len(moved) and len(beside := moved[place[moved] >= 0]):
                own -= self.squares[c][:, at[:, None], place[beside]] @ still[beside]
            gram[:, inside[:, None], inside] += self.squares[c][:, at[:, None], at] / self.variance[c]
            side[:, inside] += own / self.variance[c]
        whole, right = gram.sum(0), side.sum(0)
        grams, sides = np.concatenate([whole - gram, whole[None]]), np.concatenate([right - side, right[None]])
        grams[:, np.arange(size), np.arange(size)] += self.prior[index]
        sides += self.prior[index] * self.expected[index]
        self._fits[free] = index, self._bounded(index, grams, sides)
        return self._fits[free]

    def _bounded(self, index: Index, grams: Array, sides: Array) -> Array:
        """Solutions of normal equations (F + 1, p, p) within the bounds: what the whole would have beyond is held there
        in all of them, and the others are fitted beside it."""
        low, high = self.low[index], self.high[index]
        held = low == high
        values = np.broadcast_to(np.where(held, low, 0.0), sides.shape).copy()
        while True:
            rest = np.flatnonzero(~held)
            if not len(rest):
                return np.asarray(values)
            fixed = np.flatnonzero(held)
            beside = sides[:, rest] - (grams[:, rest[:, None], fixed] @ values[:, fixed, None])[..., 0]
            values[:, rest] = _solved(grams[:, rest[:, None], rest], beside)
            beyond = ~held & ((values[-1] < low) | (values[-1] > high))
            if not beyond.any():
                return np.asarray(np.clip(values, low, high))
            values[:, beyond] = np.clip(values[-1], low, high)[beyond]
            held |= beyond

    def fit(self, free: Iterable[int], fold: int = -1) -> Array:
        """Change of all parameters (K,) with some free and the others at their nominal values, without one fold."""
        index, values = self._fit(frozenset(free))
        change = self._still.copy()
        change[index] = values[fold]
        return change

    def at_bounds(self, change: Array) -> Index:
        """Parameters whose change (K,) is a bound that leaves room on the other side."""
        return np.flatnonzero((self.low < self.high) & ((change <= self.low) | (change >= self.high)))

    def left(self, change: Array, fold: int | None = None) -> Array:
        """Weighted squares that remain after a change of the parameters, (C, F), or of one fold (C,)."""
        out = self.totals.copy()
        moved = np.flatnonzero(change)
        for c, own, at in self._inside(moved):
            values = change[moved[own]]
            bent = (self.squares[c][:, at[:, None], at] @ values) @ values
            out[c] += 2.0 * self.products[c][:, at] @ values + bent
        out = np.maximum(out, 0.0)
        return out if fold is None else np.asarray(out[:, fold])

    def cost(self, free: Iterable[int]) -> Array:
        """Negative logarithm of the held-out likelihood of each channel, (C,)."""
        key = frozenset(free)
        if key not in self._found:
            out = self._held_out(key) if self.totals.shape[1] > 1 else self.left(self.fit(key))
            total = self.counts.sum(1)
            mean = np.where(total > 0.0, out.sum(1) / np.maximum(total, 1e-300) + self.floor**2, 1.0)
            self._found[key] = np.asarray(0.5 * total * np.log(mean))
        return self._found[key]

    def _held_out(self, free: frozenset[int]) -> Array:
        """Weighted squares of each fold as it is predicted from the others, (C, F)."""
        index, values = self._fit(free)
        still = self._still.copy()
        still[index] = 0.0
        beside = np.flatnonzero(still)
        index = np.concatenate([index, beside])
        values = np.hstack([values[:-1], np.broadcast_to(still[beside], (len(values) - 1, len(beside)))])
        out = self.totals.copy()
        for c, inside, at in self._inside(index):
            own = values[:, inside]
            bent = (self.squares[c][:, at[:, None], at] @ own[..., None])[..., 0]
            out[c] += np.sum(own * (2.0 * self.products[c][:, at] + bent), axis=1)
        return np.maximum(out, 0.0)

    def mean_squares(self, change: Array) -> Array:
        """Mean square that remains in each channel after a change of the parameters, (C,)."""
        return np.asarray(self.left(change).sum(1) / np.maximum(self.counts.sum(1), 1e-300))

    def reweighed(self, free: Iterable[int]) -> "LinearTerms":
        """The same with the scale of each channel that these parameters leave."""
        free = frozenset(free)
        squares = self.totals.sum(1) / np.maximum(self.counts.sum(1), 1e-300)
        for _ in range(REWEIGHINGS):
            terms = replace(self, variance=squares + self.floor**2, _found={}, _fits={})
            squares = terms.mean_squares(terms.fit(free))
        return terms

    @cached_property
    def _whole(self) -> tuple[Array, ...]:
        """Squares of each channel over all folds, (k, k)."""
        return tuple(squares.sum(0) for squares in self.squares)

    @cached_property
    def _matrix(self) -> tuple[Array, Array]:
        """Normal equations of all parameters and all channels, (K, K) and (K,)."""
        size = len(self.theta)
        gram, side = np.diag(self.prior), np.zeros(size)
        for c, index in enumerate(self.acting):
            if len(index) and self.counts[c].any():
                gram[index[:, None], index] += self._whole[c] / self.variance[c]
                side[index] -= self.products[c].sum(0) / self.variance[c]
        return gram, side + self.prior * self.expected

    def curvature(self, own: Index, free: Iterable[int]) -> Array:
        """Second derivatives of the cost in some parameters, all other free ones adapting, (p, p)."""
        rest = np.setdiff1d(np.array(sorted(free), np.intp), own)
        gram = self._matrix[0]
        onto = gram[np.ix_(rest, own)]
        return np.asarray(gram[np.ix_(own, own)] - onto.T @ np.linalg.lstsq(gram[np.ix_(rest, rest)], onto, 1e-12)[0])

    def promises(self, free: Iterable[int], candidates: Sequence[tuple[int, ...]]) -> Array:
        """How far the cost of all rows falls by each group of parameters in addition to free ones, which adapt to it by
        the present weights, (M,)."""
        gram, side = self._matrix
        index = np.array(sorted(free), np.intp)
        floor = 1e-6 * np.diag(gram) + 1e-300
        change = self.fit(index.tolist())
        left = side - gram[:, index] @ change[index]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(gram)[index], 1e-300))
        scaled = gram[np.ix_(index, index)] * scale * scale[:, None] + RIDGE * np.eye(len(index))
        root = np.linalg.cholesky(scaled)
        half = np.linalg.solve(root, scale[:, None] * gram[index])
        adapting = -scale[:, None] * np.linalg.solve(root.T, half)
        out = np.zeros(len(candidates))
        widths = np.array([len(each) for each in candidates])
        for width in np.unique(widths):
            same = np.flatnonzero(widths == width)
            own = np.array([candidates[k] for k in same.tolist()], np.intp)
            taken = np.moveaxis(half[:, own], 0, -1)  # by the free parameters, which adapt
            blocks = gram[own[:, :, None], own[:, None, :]] - taken @ taken.swapaxes(1, 2)
            blocks += floor[own][:, :, None] * np.eye(width)
            aim = left[own]
            low, high = self.low[own], self.high[own]
            held = low == high
            fixed = np.where(held, low, 0.0)
            beside = np.where(held, fixed, aim - (blocks @ fixed[..., None])[..., 0])
            free_blocks = np.where(held[:, :, None] | held[:, None, :], np.eye(width), blocks)
            values = np.clip(np.linalg.solve(free_blocks, beside[..., None])[..., 0], low, high)
            out[same] = self._falls(change, index, (adapting[:, own] * values).sum(2).T, own, values)
        return out

    def _falls(self, change: Array, index: Index, moved: Array, own: Index, values: Array) -> Array:
        """Falls of the cost of all rows from a change (K,) on, by changes of free parameters (p,), (M, p), and of M
        groups of others, (M, w) each, at these values."""
        out, before = np.zeros(len(own)), self.left(change).sum(1)
        for c, place in enumerate(self._places):
            count = self.counts[c].sum()
            if not count or not len(self.acting[c]):
                continue
            whole, inside, at = self._whole[c], place[index] >= 0, place[own]
            i, d, x = place[index][inside], moved[:, inside], np.where(at >= 0, values, 0.0)
            slope = 2.0 * (self.products[c].sum(0) + whole @ change[self.acting[c]])
            bent = ((whole[at[:, :, None], at[:, None, :]] @ x[..., None])[..., 0] * x).sum(1)
            bent += (d @ whole[np.ix_(i, i)] * d).sum(1) + 2.0 * ((whole[i][:, at] * x).sum(2).T * d).sum(1)
            after = np.maximum(before[c] + (slope[at] * x).sum(1) + d @ slope[i] + bent, 0.0)
            floor = count * self.floor[c] ** 2 + 1e-300
            out += 0.5 * count * np.log((before[c] + floor) / (after + floor))
        return out

    def freedom(self, parameters: Sequence[int]) -> float:
        """Effective number of parameters: those whose plausible size would show in the data; at least 1."""
        own = np.array(parameters, np.intp)
        gram = np.zeros((len(own), len(own)))
        for c, place in enumerate(self._places):
            if np.all(place[own] >= 0):
                gram += self._whole[c][np.ix_(place[own], place[own])] / self.floor[c] ** 2
        spread = 1.0 / np.sqrt(np.maximum(self.prior[own], 1e-300))
        values = np.maximum(np.linalg.eigvalsh(gram * spread * spread[:, None]), 0.0)
        return max(float(np.sum(values / (1.0 + values))), 1.0)


def _solved(grams: Array, sides: Array) -> Array:
    """Solutions of normal equations (…, p, p) and (…, p)."""
    if not sides.shape[-1]:
        return sides.copy()
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(grams, axis1=-2, axis2=-1), 1e-300))
    scaled = grams * scale[..., None, :] * scale[..., None] + RIDGE * np.eye(sides.shape[-1])
    return np.asarray(scale * np.linalg.solve(scaled, (scale * sides)[..., None])[..., 0])


def fold_sums(
    slopes: Iterable[Array], residual: Array, weight: Array, fold: Index
) -> tuple[tuple[Array, ...], tuple[Array, ...], Array, Array]:
    """Squares and products of normal equations, squares of the residuals and weights, of each channel and fold.

    Derivatives of each channel's residual (k, N), residuals (C, N), weights of rows (C, N), fold of each row (N,).
    """
    members = [np.flatnonzero(fold == f) for f in range(int(fold.max()) + 1)]
    squares, products = list[Array](), list[Array]()
    for x, y, w in zip(slopes, residual, weight, strict=True):
        squares.append(np.stack([(x[:, m] * w[m]) @ x[:, m].T for m in members]))
        products.append(np.stack([x[:, m] @ (w[m] * y[m]) for m in members]))
    totals, counts = (np.stack([z[:, m].sum(1) for m in members], axis=1) for z in (weight * residual**2, weight))
    return tuple(squares), tuple(products), totals, counts


def terms_of(problem: EstimationProblem, about: Linearised, folds: Index) -> LinearTerms:
    """Normal equations about a point; `folds` is the fold of each block."""
    variance = scale_of(problem, about.residual)
    weight = problem.weight * robust_weight(about.residual, variance, problem.freedom)
    fold = folds[problem.block]
    squares, products, totals, _ = fold_sums(about.slopes, about.residual, weight, fold)
    counts = np.stack([problem.weight[:, fold == f].sum(1) for f in range(totals.shape[1])], axis=1)
    away = np.where(np.isfinite(problem.nominal), problem.nominal - about.theta, np.nan)
    unbounded = np.full(len(away), np.inf)
    return LinearTerms(
        about.theta, about.acting, squares, products, totals, counts, variance, problem.floor, away,
        precision(problem), np.nan_to_num(away), -unbounded, unbounded,
    )  # fmt: skip


def price_of(effect: Effect[Name]) -> float:
    return PRICE * len(effect.parameters) if effect.price is None else effect.price
