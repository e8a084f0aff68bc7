"""Normal equations of all candidate terms at once, per row and fold: trying a set of terms costs microseconds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_gap.effects.registry import Columns, Layout, Row, Shape, effects
from sim_gap.residual import ResidualSet
from sim_gap.rigid import Array

CORRELATED = 8.0
"""Samples of one effective observation: residuals of real arms are correlated over a third of a second or more."""


@dataclass(frozen=True)
class Term:
    """One effect at one place with one shape."""

    effect: str
    place: int
    shape: Shape = ()

    @property
    def key(self) -> tuple[str, int]:
        """Effect and place, whatever the shape."""
        return self.effect, self.place

    def reshaped(self, entry: int, value: float) -> "Term":
        """The same term with one entry of its shape changed."""
        return Term(self.effect, self.place, (*self.shape[:entry], value, *self.shape[entry + 1 :]))

    def covers(self, layout: Layout) -> tuple[tuple[str, int], ...]:
        """Keys of the terms that it contains."""
        return effects()[self.effect].covers(layout, self.place)

    @property
    def beneath(self) -> tuple[tuple[str, int], ...]:
        """Keys of the terms that it stands upon."""
        return tuple((name, self.place) for name in effects()[self.effect].needs)


class ColumnStore:
    """Filtered columns of terms on one residual set, computed once."""

    def __init__(self, data: ResidualSet) -> None:
        self.data = data
        self._columns: dict[Term, Columns] = {}

    def columns(self, term: Term) -> Columns:
        """Columns per row, (K, p) each; rows that the term does not touch are absent."""
        if term not in self._columns:
            self._columns[term] = self.data.columns(effects()[term.effect], term.place, term.shape)
        return self._columns[term]


class Normal:
    """Gram matrices of the terms' columns with each other and with the residuals, per fold and row."""

    def __init__(self, store: ColumnStore, terms: Sequence[Term]) -> None:
        data = store.data
        self.terms = [term for term in terms if store.columns(term)]
        self.rows, self.layout = data.rows, data.layout
        self.known_friction = data.signals[0].arm.frictionloss
        widths = [next(iter(store.columns(term).values())).shape[1] for term in self.terms]
        ends = np.cumsum([0, *widths])
        self.at = {term: np.arange(ends[i], ends[i + 1]) for i, term in enumerate(self.terms)}
        self.size = int(ends[-1])
        self.folds = int(data.folds.max()) + 1
        shape = (self.folds, len(self.rows))
        self.square, self.count = np.zeros(shape), np.zeros(shape)
        self.blocks: list[_Block] = []
        self.floor = np.array([data.care[row] for row in self.rows])
        for r, row in enumerate(self.rows):
            self._accumulate(store, r, row)
        self.seen = self.count.sum(0) > 25
        spreads = [data.spread(effects()[term.effect], term.place) for term in self.terms]
        spread = np.concatenate([np.broadcast_to(s, w) for s, w in zip(spreads, widths, strict=True)] or [np.zeros(0)])
        mean_square = np.zeros(self.size)
        for block in self.blocks:
            mean_square[block.index] += np.diagonal(block.gram.sum(0)) / max(self.count.sum(), 1.0)
        self.prior = 1.0 / spread**2 + 1e-9 * mean_square
        self.prior[mean_square == 0.0] += 1.0

    def _accumulate(self, store: ColumnStore, r: int, row: Row) -> None:
        data = store.data
        touching = [term for term in self.terms if row in store.columns(term)]
        valid, y = data.valid[row], data.values[row]
        index = np.concatenate([self.at[term] for term in touching] or [np.zeros(0, int)]).astype(int)
        x = np.hstack([store.columns(term)[row] for term in touching]) if touching else np.zeros((len(y), 0))
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
        """Weight of one sample of each row: 1/(floor² + R²), less the correlation of neighbours."""
        return np.asarray(np.where(self.seen, 1.0 / (self.floor**2 + mean_square) / CORRELATED, 0.0))

    def index(self, terms: Sequence[Term]) -> NDArray[np.intp]:
        """Positions of the terms' coefficients."""
        return np.concatenate([self.at[term] for term in terms] or [np.zeros(0, np.intp)]).astype(np.intp)

    def solve(self, index: NDArray[np.intp], gram: Array, side: Array) -> Array:
        """Coefficients at `index` from the weighted sums (P, P) and (P,), with the prior."""
        matrix = gram[np.ix_(index, index)] + np.diag(self.prior[index])
        scale = 1.0 / np.sqrt(np.diag(matrix))
        return np.asarray(
            scale * np.linalg.solve(matrix * scale * scale[:, None] + 1e-10 * np.eye(len(index)), scale * side[index])
        )

    def mean_square(self, index: NDArray[np.intp], coefficients: Array) -> Array:
        """Residual's mean square per row after the terms, (R,)."""
        errors = sum((self.errors(index, coefficients, fold) for fold in range(self.folds)), np.zeros(len(self.rows)))
        return np.asarray(errors / np.maximum(self.count.sum(0), 1.0))

    def errors(self, index: NDArray[np.intp], coefficients: Array, fold: int) -> Array:
        """Sum of squares per row after the terms over one fold, (R,)."""
        out = self.square[fold].copy()
        for r, block in enumerate(self.blocks):
            at = block.position[index]
            there = at >= 0
            at, c = at[there], coefficients[there]
            if len(at):
                out[r] += c @ (block.gram[fold][at[:, None], at] @ c - 2.0 * block.side[fold][at])
        return np.asarray(np.maximum(out, 0.0))


@dataclass(frozen=True)
class _Block:
    """Sums of one row over the columns that touch it."""

    index: NDArray[np.intp]
    """Those columns among all, (p,)."""
    position: NDArray[np.intp]
    """Place of every column among those, −1 where it does not touch the row, (P,)."""
    gram: Array
    side: Array
    """(F, p, p) and (F, p)."""


class Weighted:
    """Normal equations under given row weights: fits, cross-validates, screens."""

    def __init__(self, normal: Normal, mean_square: Array) -> None:
        self.normal = normal
        weights = normal.weights(mean_square)
        gram = np.zeros((normal.folds, normal.size, normal.size))
        side = np.zeros((normal.folds, normal.size))
        for weight, block in zip(weights, normal.blocks, strict=True):
            if weight > 0.0 and len(block.index):
                gram[:, block.index[:, None], block.index] += weight * block.gram
                side[:, block.index] += weight * block.side
        self.gram, self.side = gram.sum(0), side.sum(0)
        self.others_gram, self.others_side = self.gram - gram, self.side - side

    def fit(self, terms: Sequence[Term]) -> tuple[NDArray[np.intp], Array]:
        """Indices and coefficients of the terms on all folds."""
        index = self.normal.index(terms)
        return index, self.normal.solve(index, self.gram, self.side)

    def cross_validated(self, terms: Sequence[Term]) -> Array:
        """Mean square per row, each fold predicted from the others, (R,)."""
        normal, index = self.normal, self.normal.index(terms)
        errors = np.zeros(len(normal.rows))
        for fold in range(normal.folds):
            coefficients = normal.solve(index, self.others_gram[fold], self.others_side[fold])
            errors += normal.errors(index, coefficients, fold)
        return np.asarray(errors / np.maximum(normal.count.sum(0), 1.0))

    def screen(self, terms: Sequence[Term], candidates: Sequence[Term]) -> list[tuple[float, Term]]:
        """Candidates by the fall of the weighted squares that each would bring on top of `terms`, best first."""
        normal, index = self.normal, self.normal.index(terms)
        full, side = self.gram, self.side
        matrix = full[np.ix_(index, index)] + np.diag(normal.prior[index])
        through = np.linalg.solve(matrix, np.column_stack([full[index], side[index]])) if len(index) else None
        falls = []
        for candidate in candidates:
            own = normal.at[candidate]
            block, left = full[np.ix_(own, own)] + np.diag(normal.prior[own]), side[own]
            floor = 1e-6 * np.diag(block) + 1e-300
            if through is not None:
                onto = full[np.ix_(own, index)]
                block, left = block - onto @ through[:, own], left - onto @ through[:, -1]
            falls.append((float(left @ np.linalg.solve(block + np.diag(floor), left)), candidate))
        return sorted(falls, key=lambda pair: -pair[0])
