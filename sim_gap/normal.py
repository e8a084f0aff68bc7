"""Normal equations of all candidate terms at once, per row and fold: trying a set of terms costs microseconds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_gap.effects.registry import Columns, Row, Shape, effects
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


@dataclass(frozen=True)
class Solution:
    """Coefficients of a set of terms."""

    terms: tuple[Term, ...]
    coefficients: dict[Term, Array]


class Normal:
    """Gram matrices of the terms' columns with each other and with the residuals, per fold and row."""

    def __init__(self, store: ColumnStore, terms: Sequence[Term]) -> None:
        data = store.data
        self.terms = [term for term in terms if store.columns(term)]
        self.rows = data.rows
        widths = [next(iter(store.columns(term).values())).shape[1] for term in self.terms]
        ends = np.cumsum([0, *widths])
        self.at = {term: np.arange(ends[i], ends[i + 1]) for i, term in enumerate(self.terms)}
        self.size = int(ends[-1])
        self.folds = int(data.folds.max()) + 1
        shape = (self.folds, len(self.rows))
        self.gram = np.zeros((*shape, self.size, self.size))
        self.side = np.zeros((*shape, self.size))
        self.square = np.zeros(shape)
        self.count = np.zeros(shape)
        self.floor = np.array([data.care[row] for row in self.rows])
        for r, row in enumerate(self.rows):
            self._accumulate(store, r, row)
        self.seen = self.count.sum(0) > 25
        spreads = [data.spread(effects()[term.effect], term.place) for term in self.terms]
        spread = np.concatenate([np.broadcast_to(s, w) for s, w in zip(spreads, widths, strict=True)] or [np.zeros(0)])
        mean_square = np.einsum("frpp->p", self.gram) / max(self.count.sum(), 1.0)
        self.prior = 1.0 / spread**2 + 1e-9 * mean_square
        self.prior[mean_square == 0.0] += 1.0

    def _accumulate(self, store: ColumnStore, r: int, row: Row) -> None:
        data = store.data
        touching = [term for term in self.terms if row in store.columns(term)]
        valid, y = data.valid[row], data.values[row]
        index = np.concatenate([self.at[term] for term in touching] or [np.zeros(0, int)]).astype(int)
        x = np.hstack([store.columns(term)[row] for term in touching]) if touching else np.zeros((len(y), 0))
        for fold in range(self.folds):
            pick = valid & (data.folds == fold)
            part, target = x[pick], y[pick]
            self.gram[fold, r][np.ix_(index, index)] = part.T @ part
            self.side[fold, r, index] = part.T @ target
            self.square[fold, r] = target @ target
            self.count[fold, r] = pick.sum()

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

    def mean_square(self, index: NDArray[np.intp], coefficients: Array, fold: int | None = None) -> Array:
        """Residual's mean square per row after the terms, over one fold or all, (R,)."""
        folds = slice(None) if fold is None else slice(fold, fold + 1)
        return np.asarray(self._errors(index, coefficients, folds) / np.maximum(self.count[folds].sum(0), 1.0))

    def _errors(self, index: NDArray[np.intp], coefficients: Array, folds: slice) -> Array:
        gram = self.gram[folds][:, :, index][..., index].sum(0)
        side = self.side[folds][..., index].sum(0)
        error = (
            self.square[folds].sum(0)
            - 2.0 * side @ coefficients
            + np.einsum("p,rpq,q->r", coefficients, gram, coefficients)
        )
        return np.asarray(np.maximum(error, 0.0))


class Weighted:
    """Normal equations under given row weights: fits, cross-validates, screens."""

    def __init__(self, normal: Normal, mean_square: Array) -> None:
        self.normal = normal
        weights = normal.weights(mean_square)
        self.gram_fold = np.einsum("r,frpq->fpq", weights, normal.gram)
        self.side_fold = np.einsum("r,frp->fp", weights, normal.side)
        self.gram, self.side = self.gram_fold.sum(0), self.side_fold.sum(0)

    def fit(self, terms: Sequence[Term]) -> tuple[NDArray[np.intp], Array]:
        """Indices and coefficients of the terms on all folds."""
        index = self.normal.index(terms)
        return index, self.normal.solve(index, self.gram, self.side)

    def cross_validated(self, terms: Sequence[Term]) -> Array:
        """Mean square per row, each fold predicted from the others, (R,)."""
        normal, index = self.normal, self.normal.index(terms)
        errors = np.zeros(len(normal.rows))
        for fold in range(normal.folds):
            coefficients = normal.solve(index, self.gram - self.gram_fold[fold], self.side - self.side_fold[fold])
            errors += normal._errors(index, coefficients, slice(fold, fold + 1))
        return np.asarray(errors / np.maximum(normal.count.sum(0), 1.0))

    def screen(self, terms: Sequence[Term], candidates: Sequence[Term]) -> list[tuple[float, Term]]:
        """Candidates by the fall of the weighted squares that each would bring on top of `terms`, best first."""
        normal = self.normal
        index = normal.index(terms)
        full, side = self.gram + np.diag(normal.prior), self.side
        if len(index):
            through = np.linalg.solve(
                full[np.ix_(index, index)] + 1e-12 * np.eye(len(index)), np.column_stack([full[index], side[index]])
            )
            left = full - full[:, index] @ through[:, :-1]
            remaining = side - full[:, index] @ through[:, -1]
        else:
            left, remaining = full, side
        falls = []
        for candidate in candidates:
            own = normal.at[candidate]
            block = left[np.ix_(own, own)]
            floor = 1e-6 * np.diag(full)[own] + 1e-300
            falls.append((float(remaining[own] @ np.linalg.solve(block + np.diag(floor), remaining[own])), candidate))
        return sorted(falls, key=lambda pair: -pair[0])
