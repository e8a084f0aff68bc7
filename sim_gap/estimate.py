"""The final fit of the chosen terms: coefficients, honest covariance, reported parameters, predictions."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from sim_gap.effects.registry import Row, effects
from sim_gap.normal import CORRELATED, ColumnStore, Normal, Term
from sim_gap.residual import ResidualSet
from sim_gap.rigid import Array
from sim_gap.select import Search

SHAPE_STEP = 1e-2
SYSTEMATIC = 0.3
"""Share of a row's residual, and of what is not worth explaining, that may pass for any effect however long one
records."""


@dataclass(frozen=True)
class Value:
    """One reported parameter."""

    value: float
    low: float
    high: float
    unit: str


class Estimate:
    """Terms fitted to a training set."""

    def __init__(self, store: ColumnStore, terms: list[Term]) -> None:
        self.store = store
        self.normal = Normal(store, terms)
        self.terms = tuple(self.normal.terms)
        self.search = Search(self.normal, list(self.terms))
        self.index, self.coefficients = self.search.weighted.fit(self.terms)

    def of(self, term: Term) -> Array:
        """Coefficients of one term."""
        return self.coefficients[self.normal.at[term]]

    def subset(self, terms: list[Term]) -> Array:
        """Coefficients (P,) of a fit of these terms alone, zero elsewhere, under the final weights."""
        out = np.zeros(self.normal.size)
        index, values = self.search.weighted.fit(terms)
        out[index] = values
        return out

    @cached_property
    def _jacobian(self) -> list[tuple[float, Array, Array, NDArray[np.intp]]]:
        """Per row: weight, columns with shape derivatives (k, P + S), residual (k,), block (k,)."""
        data, out = self.store.data, []
        weights = self.normal.weights(self.normal.mean_square(self.index, self.coefficients))
        shaped = [(term, term.free) for term in self._shaped]
        for weight, row in zip(weights, self.normal.rows, strict=True):
            valid = data.valid[row]
            x = np.zeros((len(valid), self.normal.size + len(shaped)))
            for term in self.terms:
                if row in (columns := self.store.columns(term)):
                    x[:, self.normal.at[term]] = columns[row]
            for k, (term, i) in enumerate(shaped):
                if row in self.store.columns(term):
                    assert i is not None
                    x[:, self.normal.size + k] = self._shape_slope(term, i, row)
            residual = data.values[row] - x[:, : self.normal.size] @ self.coefficients
            out.append((float(weight), x[valid], residual[valid], data.blocks[valid]))
        return out

    @cached_property
    def _shaped(self) -> list[Term]:
        """Terms one of whose shape's entries was fitted."""
        return [term for term in self.terms if term.free is not None]

    def _shape_slope(self, term: Term, i: int, row: Row) -> Array:
        step = SHAPE_STEP * abs(term.shape[i])
        sides = []
        for sign in (1.0, -1.0):
            shape = tuple(s + sign * step * (k == i) for k, s in enumerate(term.shape))
            sides.append(self.store.columns(Term(term.effect, term.place, shape))[row] @ self.of(term))
        return np.asarray((sides[0] - sides[1]) / (2.0 * step))

    @cached_property
    def covariance(self) -> Array:
        """Of coefficients and smooth shapes, (P + S, P + S): sandwich over blocks of time, and what the rest of the arm
        being a little wrong adds: an error of SYSTEMATIC times each row's residual that follows the column itself."""
        size = self._jacobian[0][1].shape[1]
        bread, scores = np.zeros((size, size)), np.zeros((int(self.store.data.blocks.max()) + 1, size))
        for weight, x, residual, block in self._jacobian:
            bread += weight * x.T @ x
            np.add.at(scores, block, weight * x * residual[:, None])
        bread[np.arange(self.normal.size), np.arange(self.normal.size)] += self.normal.prior
        scale = 1.0 / np.sqrt(np.maximum(np.diag(bread), 1e-300))
        inverse = np.linalg.pinv(bread * scale * scale[:, None], hermitian=True, rcond=1e-10) * scale * scale[:, None]
        blocks = max(len(scores), 2)
        seen = sum(len(residual) for _, _, residual, _ in self._jacobian) / max(len(self._jacobian), 1)
        systematic = SYSTEMATIC**2 * seen / CORRELATED * inverse
        return np.asarray(inverse @ (scores.T @ scores) @ inverse * blocks / (blocks - 1) + systematic)

    def parameters(self, term: Term) -> dict[str, Value]:
        """Reported parameters with 95 % intervals."""
        effect = effects()[term.effect]
        beneath = {other.effect: other for other in self.terms if other.key in term.beneath}
        shaped, free = self._shaped, term.free
        chosen = [*self.normal.at[term], *(i for other in beneath.values() for i in self.normal.at[other])]
        if term in shaped:
            chosen.append(self.normal.size + shaped.index(term))
        own = len(self.normal.at[term])

        def evaluate(z: Array) -> Array:
            shape = term.shape if free is None else term.reshaped(free, float(z[-1])).shape
            under, at = {"nominal": self.normal.known_friction[term.place, None]}, own
            for name, other in beneath.items():
                width = len(self.normal.at[other])
                under[name], at = z[at : at + width], at + width
            return np.asarray(effect.values(z[:own], shape, under), float)

        size = () if free is None else (term.shape[free],)
        start = np.concatenate([self.of(term), *(self.of(other) for other in beneath.values()), size])
        centre, steps = evaluate(start), 1e-5 * np.maximum(np.abs(start), 1e-3)
        slopes = [
            (evaluate(start + d) - evaluate(start - d)) / (2 * s) for s, d in zip(steps, np.diag(steps), strict=True)
        ]
        jacobian = np.stack(slopes, axis=1)
        spread = np.sqrt(np.maximum(np.diag(jacobian @ self.covariance[np.ix_(chosen, chosen)] @ jacobian.T), 0.0))
        blocks = int(self.store.data.blocks.max()) + 1
        half = spread * student.ppf(0.975, max(blocks - 1, 1))
        return {
            p.name: Value(float(c), float(c - h), float(c + h), p.unit)
            for p, c, h in zip(effect.parameters, centre, half, strict=True)
        }

    def predict(
        self, data: ResidualSet, store: ColumnStore | None = None, terms: tuple[Term, ...] | None = None
    ) -> dict[Row, Array]:
        """What the terms explain on another set, (K,) per row."""
        store = store or ColumnStore(data)
        out = {row: np.zeros(sum(data.lengths)) for row in data.rows}
        for term in self.terms if terms is None else terms:
            for row, columns in store.columns(term).items():
                out[row] += columns @ self.of(term)
        return out
