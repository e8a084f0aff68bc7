"""Normal equations of all candidate terms, by row and fold: any subset of terms is fitted in microseconds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array
from sim_gap.residuals.layout import Row
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.term import Term

PRICE = 0.012
"""Least decrease of Σ ½ log(R² + floor²) over all rows per coefficient: about 1 % of one row's RMS."""
PINNED = 1e9
"""Weight of the coefficients that are one, in units of the data's."""
CORRELATED = 8.0
"""Samples per effective observation: residuals of real arms are correlated over a third of a second or more."""


class NormalEquations:
    """Gram matrices of the terms' columns with each other and with the residuals, per fold and row."""

    def __init__(self, store: ColumnStore, terms: Sequence[Term], like: "NormalEquations | None" = None) -> None:
        """`like` has the same coefficients, on other data."""
        data = store.data
        self.store = store
        self.terms = [term for term in terms if store.columns(term)]
        self.rows, self.layout = data.rows, data.layout
        arm = data.signals[0].arm
        speed = np.sqrt(np.mean([np.mean(s.v**2, axis=0) for s in data.signals], axis=0))
        of_motor = float(self.layout.motor is not None)
        known = [of_motor * arm.frictionloss, of_motor * arm.damping, of_motor * arm.armature]
        self.known_joint = np.stack([*known, speed], axis=1)
        """Friction, damping and armature of the nominal model, and the joint's usual speed, (n, 4) as in `Beneath`.

        A sensor on the link reads nothing of the motor's."""
        self.tip_mass = arm.inertial[-1, :1]
        widths = [next(iter(store.columns(term).values())).shape[1] for term in self.terms]
        ends = np.cumsum([0, *widths])
        self.at = {term: np.arange(ends[i], ends[i + 1]) for i, term in enumerate(self.terms)}
        held = [term for term in self.terms if (term in like.fixed if like else store.offset(term))]
        self.fixed: dict[Term, int] = {term: int(ends[-1]) + k for k, term in enumerate(held)}
        """Index of the column that a nonlinear term has beside its own; its coefficient is one."""
        self.size = int(ends[-1]) + len(held)
        self.folds = int(data.folds.max()) + 1
        shape = (self.folds, len(self.rows))
        self.square, self.count = np.zeros(shape), np.zeros(shape)
        self.blocks: list[_Block] = []
        self._freedom: dict[Term, float] = {}
        self.floor = np.array([data.relevance_floor[row] for row in self.rows])
        for r, row in enumerate(self.rows):
            self._accumulate(store, r, row)
        store.release()
        self.seen = self.count.sum(0) > 25
        spreads = [term.form.plausibility.prior_std(data.signals[0], term.place) for term in self.terms]
        own = [np.broadcast_to(s, w) for s, w in zip(spreads, widths, strict=True)]
        spread = np.concatenate([*own, np.full(len(held), np.inf)])
        mean_square = np.zeros(self.size)
        for block in self.blocks:
            mean_square[block.index] += np.diagonal(block.whole) / max(self.count.sum(), 1.0)
        self.prior = 1.0 / spread**2 + 1e-9 * mean_square
        self.prior[mean_square == 0.0] += 1.0
        last = list(self.fixed.values())
        self.prior[last] = PINNED * (
            1.0 + mean_square[last] * self.count.sum() / float(self.floor.min(initial=1.0)) ** 2
        )
        means = [np.full(w, term.form.plausibility.prior_mean) for term, w in zip(self.terms, widths, strict=True)]
        self.pull = self.prior * np.concatenate([*means, np.ones(len(held))])

        self.free = self.prior.copy()
        """The prior without the coefficients that are kept."""
        self.pin({term: c for term, c in store.pins.items() if term in self.at})

    def pin(self, kept: Mapping[Term, Array]) -> None:
        power = sum((b.diagonal(self.size) for b in self.blocks), np.zeros(self.size))
        for term, c in kept.items():
            at = self.at[term]
            self.prior[at] = PINNED * (1.0 + power[at] / float(self.floor.min(initial=1.0)) ** 2)
            self.pull[at] = self.prior[at] * c

    @property
    def price(self) -> float:
        """Decrease of Σ ½ log(R² + floor²) over all rows that a coefficient must bring: more if there is little data.

        ½ log(N)/N for N effective observations of a row (Schwarz), but at least PRICE.
        """
        effective = max(float(self.count.sum(0).max(initial=0.0)) / CORRELATED, 3.0)
        return max(PRICE, 0.5 * float(np.log(effective)) / effective)

    def _accumulate(self, store: ColumnStore, r: int, row: Row) -> None:
        data = store.data
        touching = [term for term in self.terms if row in store.columns(term)]
        valid, y = data.valid[row], data.values[row]
        index = self.index(touching)
        x = store.wide(touching, row, self.fixed)
        gram, side = np.zeros((self.folds, len(index), len(index))), np.zeros((self.folds, len(index)))
        for fold in range(self.folds):
            pick = valid & (data.folds == fold)
            part, target = x[pick], y[pick]
            gram[fold], side[fold] = part.T @ part, part.T @ target
            self.square[fold, r], self.count[fold, r] = target @ target, pick.sum()
        position = np.full(self.size, -1)
        position[index] = np.arange(len(index))
        self.blocks.append(_Block(index, position, gram, side))

    def weights(self, mean_square: Array) -> Array:
        """Weight of one sample of each row: 1/(floor² + R²), divided by the correlation length in samples."""
        return np.asarray(np.where(self.seen, 1.0 / (self.floor**2 + mean_square) / CORRELATED, 0.0))

    def index(self, terms: Sequence[Term]) -> NDArray[np.intp]:
        """Indices of the terms' coefficients, then of the columns beside them (`fixed`)."""
        beside = [np.array([self.fixed[term]]) for term in terms if term in self.fixed]
        return np.concatenate([*(self.at[term] for term in terms), *beside, np.zeros(0, np.intp)]).astype(np.intp)

    def solve(self, index: NDArray[np.intp], gram: Array, side: Array) -> Array:
        """Coefficients at `index` from their weighted sums (…, p, p) and (…, p), with the prior."""
        matrix, right = gram + np.diag(self.prior[index]), side + self.pull[index]
        scale = 1.0 / np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))
        scaled = matrix * scale[..., None, :] * scale[..., None] + 1e-10 * np.eye(len(index))
        return np.asarray(scale * np.linalg.solve(scaled, (scale * right)[..., None])[..., 0])

    def mean_square(self, index: NDArray[np.intp], coefficients: Array) -> Array:
        """Mean square of the residual per row after subtracting the terms, (R,)."""
        squares = self.square.sum(0)
        for r, block in enumerate(self.blocks):
            there = block.position[index] >= 0
            at, c = block.position[index[there]], coefficients[there]
            squares[r] += c @ (block.whole[at[:, None], at] @ c - 2.0 * block.side.sum(0)[at])
        return np.asarray(np.maximum(squares, 0.0) / np.maximum(self.count.sum(0), 1.0))

    def freedom(self, term: Term) -> float:
        """Effective number of a term's coefficients: those whose plausible size would show in the data; at least 1."""
        if term not in self._freedom:
            at = self.at[term]
            gram = np.zeros((len(at), len(at)))
            for weight, block in zip(self.weights(np.zeros(len(self.rows))), self.blocks, strict=True):
                inside = block.position[at]
                if np.all(inside >= 0):
                    gram += weight * block.whole[np.ix_(inside, inside)]
            spread = 1.0 / np.sqrt(self.prior[at])
            values = np.maximum(np.linalg.eigvalsh(gram * spread * spread[:, None]), 0.0)
            self._freedom[term] = max(float(np.sum(values / (1.0 + values))), 1.0)
        return self._freedom[term]

    def size_of(self, term: Term, index: NDArray[np.intp], coefficients: Array) -> Array:
        """RMS of a term in each row with these coefficients of all terms, (R,)."""
        values = dict(zip(index.tolist(), coefficients.tolist(), strict=True))
        c, out = np.array([values[i] for i in self.at[term].tolist()]), np.zeros(len(self.rows))
        for r, block in enumerate(self.blocks):
            at = block.position[self.at[term]]
            if np.all(at >= 0):
                out[r] = np.sqrt(max(float(c @ block.whole[np.ix_(at, at)] @ c), 0.0) / max(self.count[:, r].sum(), 1))
        return out

    def power(self, change: Array) -> Array:
        """Mean square per row of the columns times a change of all coefficients (P,), (R,)."""
        sums = [change[b.index] @ b.whole @ change[b.index] for b in self.blocks]
        return np.asarray(np.array(sums) / np.maximum(self.count.sum(0), 1.0))

    def parts(self, index: NDArray[np.intp]) -> "list[_Part]":
        """Sums of the columns `index` in each row."""
        return [block.part(index) for block in self.blocks]

    def errors(self, parts: "Sequence[_Part]", coefficients: Array) -> Array:
        """Mean square per row after subtracting columns with coefficients of each fold's own (F, p), (R,)."""
        squares = self.square.copy()
        for r, part in enumerate(parts):
            c = coefficients[:, part.there]
            squares[:, r] += np.sum(c * ((part.gram @ c[..., None])[..., 0] - 2.0 * part.side), axis=1)
        return np.asarray(np.maximum(squares, 0.0).sum(0) / np.maximum(self.count.sum(0), 1.0))


@dataclass(frozen=True)
class _Block:
    """Sums of one row over the columns that touch it."""

    index: NDArray[np.intp]
    """Indices of those columns among all, (p,)."""
    position: NDArray[np.intp]
    """Position of every column among those, −1 for a column that does not touch the row, (P,)."""
    gram: Array
    side: Array
    """(F, p, p) and (F, p)."""

    def diagonal(self, size: int) -> Array:
        """Sums of squares of all columns, (P,)."""
        out = np.zeros(size)
        out[self.index] = np.diagonal(self.whole)
        return out

    @cached_property
    def whole(self) -> Array:
        """Gram matrix over all folds, (p, p)."""
        return np.asarray(self.gram.sum(0))

    def part(self, index: NDArray[np.intp]) -> "_Part":
        there = np.flatnonzero(self.position[index] >= 0)
        at = self.position[index[there]]
        return _Part(there, self.gram[:, at[:, None], at], self.side[:, at])


@dataclass(frozen=True)
class _Part:
    """Sums of one row over those of some columns that touch it."""

    there: NDArray[np.intp]
    """Positions of these columns among those asked for, (q,)."""
    gram: Array
    side: Array
    """(F, q, q) and (F, q)."""


class Weighted:
    """Normal equations with given row weights: fit, cross-validation, screening."""

    def __init__(self, normal: NormalEquations, mean_square: Array) -> None:
        self.normal = normal
        self.weights = normal.weights(mean_square)
        self.gram, self.side = np.zeros((normal.size, normal.size)), np.zeros(normal.size)
        for weight, block in zip(self.weights, normal.blocks, strict=True):
            if weight > 0.0 and len(block.index):
                self.gram[block.index[:, None], block.index] += weight * block.whole
                self.side[block.index] += weight * block.side.sum(0)

    def fit(self, terms: Sequence[Term]) -> tuple[NDArray[np.intp], Array]:
        """Indices and coefficients of the terms, fitted to all folds."""
        index = self.normal.index(terms)
        return index, self.normal.solve(index, self.gram[np.ix_(index, index)], self.side[index])

    def cross_validated(self, terms: Sequence[Term]) -> Array:
        """Mean square per row, each fold predicted from a fit to the others, (R,)."""
        index = self.normal.index(terms)
        parts = self.normal.parts(index)
        return self.normal.errors(parts, self.normal.solve(index, *self._without_fold(index, parts)))

    def _without_fold(self, index: NDArray[np.intp], parts: Sequence[_Part]) -> tuple[Array, Array]:
        """Weighted sums over all folds but one, for each fold, of the columns `index`, (F, p, p) and (F, p)."""
        folds, size = self.normal.folds, len(index)
        gram, side = np.zeros((folds, size, size)), np.zeros((folds, size))
        for weight, part in zip(self.weights, parts, strict=True):
            if weight > 0.0 and len(part.there):
                gram[:, part.there[:, None], part.there] += weight * part.gram
                side[:, part.there] += weight * part.side
        return self.gram[np.ix_(index, index)] - gram, self.side[index] - side

    def screen(self, terms: Sequence[Term], candidates: Sequence[Term]) -> list[tuple[float, Term]]:
        """Candidates by the decrease of the weighted squares that each brings in addition to `terms`, best first."""
        normal, index = self.normal, self.normal.index(terms)
        matrix, left = self.gram + np.diag(normal.prior), self.side.copy()
        beside = np.array(list(normal.fixed.values()), np.intp)
        left[beside] += normal.pull[beside]
        if len(index):
            onto = self.gram[:, index]
            through = np.linalg.solve(matrix[np.ix_(index, index)], np.column_stack([onto.T, left[index]]))
            rest = onto @ through
            floor = 1e-6 * np.diag(matrix)
            matrix, left = matrix - rest[:, :-1], left - rest[:, -1]
        else:
            floor = 1e-6 * np.diag(matrix)
        falls: list[tuple[float, Term]] = []
        widths = np.array([len(normal.at[candidate]) for candidate in candidates], int)
        for width in np.unique(widths).tolist():
            same = [candidates[i] for i in np.flatnonzero(widths == width).tolist()]
            own = np.array([normal.at[candidate] for candidate in same])
            blocks = matrix[own[:, :, None], own[:, None, :]] + (floor[own] + 1e-300)[:, :, None] * np.eye(width)
            at = np.array([normal.fixed.get(candidate, -1) for candidate in same])
            aim, there = left[own], np.flatnonzero(at >= 0)
            first = np.zeros(len(same))
            if len(there):  # what a nonlinear candidate is beside its columns comes first
                f = at[there]
                aim[there] -= np.take_along_axis(matrix[f], own[there], axis=1)
                power = matrix[f, f] - normal.prior[f]
                first[there] = 2.0 * (left[f] - normal.pull[f]) - power
            gains = first + np.einsum("ki,ki->k", aim, np.linalg.solve(blocks, aim[..., None])[..., 0])
            falls += zip(gains.tolist(), same, strict=True)
        return sorted(falls, key=lambda pair: -pair[0])
