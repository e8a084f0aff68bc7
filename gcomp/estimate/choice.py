"""Which effects: forward and backward by the likelihood of rows that are held out, each parameter at one price.

All is linear about one point, so that a choice takes no further evaluation of the problem.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from gcomp.arrays import Array
from gcomp.estimate.problem import EstimationProblem, Index, Linearised
from gcomp.estimate.solve import precision, robust_weight, scale_of

PRICE = 4.0
"""Fall of the negative logarithm of the held-out likelihood that a parameter has to pay for: the best of m useless ones
brings log m of rows that are fitted (risk inflation criterion, Foster and George, Annals of Statistics 22, 1994), and
one less of rows that are held out. A six-joint arm has m = 150: log 150 − 1 = 4.0."""
SIGNIFICANT = 2.0
"""Standard errors over the blocks by which an effect has to pay: 98 % of a normal distribution, one-sided."""


@dataclass(frozen=True)
class Effect:
    """Parameters that come together, and what they need beside them."""

    name: str
    parameters: tuple[int, ...]
    needs: tuple[str, ...] = ()
    least: float = 0.0
    """Fall of the cost that it has to bring, if that is more than the price."""


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
    """Nominal value less that of the point, (K,); NaN where there is none."""
    prior: Array
    """Inverse variance of each parameter before any measurement, (K,)."""
    _found: dict[frozenset[int], tuple[Array, Array]] = field(default_factory=dict)

    def fit(self, free: Iterable[int], fold: int = -1) -> Array:
        """Change of all parameters (K,) with some free and the others at their nominal values, without one fold."""
        free = sorted(set(free))
        size = len(self.theta)
        change = np.nan_to_num(self.away)
        change[free] = 0.0
        normal, right = np.diag(self.prior), np.zeros(size)
        for c, index in enumerate(self.acting):
            square, product = self.squares[c].sum(0), self.products[c].sum(0)
            if fold >= 0:
                square, product = square - self.squares[c][fold], product - self.products[c][fold]
            normal[np.ix_(index, index)] += square / self.variance[c]
            right[index] -= (product + square @ change[index]) / self.variance[c]
        right += self.prior * np.nan_to_num(self.away) * (self.prior > 0.0)
        if free:
            own = normal[np.ix_(free, free)]
            own[np.diag_indices(len(free))] *= 1.0 + 1e-9
            change[free] = np.linalg.lstsq(own, right[free], rcond=1e-12)[0]
        return change

    def left(self, change: Array, fold: int | None = None) -> Array:
        """Weighted squares that remain after a change of the parameters, (C, F), or of one fold (C,)."""
        out = self.totals.copy()
        for c, index in enumerate(self.acting):
            own = change[index]
            out[c] += 2.0 * self.products[c] @ own + np.einsum("a,fab,b->f", own, self.squares[c], own)
        out = np.maximum(out, 0.0)
        return out if fold is None else np.asarray(out[:, fold])

    def costs(self, free: Iterable[int]) -> Array:
        """Negative logarithm of the held-out likelihood of each channel and fold, (C, F)."""
        key = frozenset(free)
        if key not in self._found:
            folds = self.totals.shape[1]
            if folds > 1:
                out = np.stack([self.left(self.fit(key, f), f) for f in range(folds)], axis=1)
            else:
                out = self.left(self.fit(key))
            mean = out.sum(1) / np.maximum(self.counts.sum(1), 1e-300) + self.floor**2
            share = out / np.maximum(out.sum(1, keepdims=True), 1e-300)
            each = 0.5 * self.counts * np.log(mean)[:, None] + 0.5 * (
                share * self.counts.sum(1, keepdims=True) - self.counts
            )
            self._found[key] = each, np.asarray(0.5 * self.counts.sum(1) * np.log(mean))
        return self._found[key][0]

    def cost(self, free: Iterable[int]) -> Array:
        """The same of each channel, (C,)."""
        key = frozenset(free)
        self.costs(key)
        return self._found[key][1]


def terms_of(problem: EstimationProblem, about: Linearised, folds: Index) -> LinearTerms:
    """Normal equations about a point; `folds` is the fold of each block."""
    fold, count = folds[problem.block], int(folds.max()) + 1
    variance = scale_of(problem, about.residual)
    weight = problem.weight * robust_weight(about.residual, variance, problem.freedom)
    members = [np.flatnonzero(fold == f) for f in range(count)]
    squares, products = [], []
    for c, x in enumerate(about.slopes):
        squares.append(np.stack([(x[:, m] * weight[c, m]) @ x[:, m].T for m in members]))
        products.append(np.stack([x[:, m] @ (weight[c, m] * about.residual[c, m]) for m in members]))
    own = weight * about.residual**2
    totals, counts = (np.stack([y[:, m].sum(1) for m in members], axis=1) for y in (own, problem.weight))
    away = np.where(np.isfinite(problem.nominal), problem.nominal - about.theta, np.nan)
    return LinearTerms(
        about.theta,
        about.acting,
        tuple(squares),
        tuple(products),
        totals,
        counts,
        variance,
        problem.floor,
        away,
        precision(problem),
    )


@dataclass(frozen=True)
class HeldOutEvidence:
    """How much better one set of effects predicts held-out rows than another."""

    fall: float
    """Fall of the negative logarithm of the likelihood."""
    error: float
    """Its standard error over the folds."""


def evidence(terms: LinearTerms, less: Iterable[int], more: Iterable[int]) -> HeldOutEvidence:
    each = (terms.costs(less) - terms.costs(more)).sum(0)
    fall = float((terms.cost(less) - terms.cost(more)).sum())
    return HeldOutEvidence(fall, float(each.std(ddof=1) * np.sqrt(len(each))) if len(each) > 1 else 0.0)


def price_of(effect: Effect) -> float:
    return max(PRICE * len(effect.parameters), effect.least)


def choose(
    terms: LinearTerms,
    effects: Sequence[Effect],
    chosen: Iterable[str],
    kept: Iterable[str] = (),
    most: int = 1000,
    progress: Callable[[str], None] = lambda text: None,
) -> list[str]:
    """Effects in the order in which they pay most beside those there, from the ones `chosen` on; then those that do
    not pay any more are taken out, but for those `kept`."""
    by_name = {effect.name: effect for effect in effects}
    current = [name for name in chosen if name in by_name]

    def free(names: Iterable[str]) -> frozenset[int]:
        return frozenset(k for name in names for k in by_name[name].parameters)

    def pays(less: Sequence[str], more: Sequence[str], effect: Effect) -> float:
        """Gain beyond the price; not positive for one that is not sure over the folds."""
        shown = evidence(terms, free(less), free(more))
        sure = shown.fall > SIGNIFICANT * shown.error or shown.error == 0.0
        return shown.fall - price_of(effect) if sure else -np.inf

    dead = set[str]()
    for _ in range(most):
        best, gain = "", 0.0
        for effect in effects:
            if effect.name in current or effect.name in dead or not set(effect.needs) <= set(current):
                continue
            worth = pays(current, [*current, effect.name], effect)
            if worth > gain:
                best, gain = effect.name, worth
        if not best:
            break
        progress(best)
        current.append(best)
    fixed = set(kept)
    while True:
        needed = {need for name in current for need in by_name[name].needs}
        losses = [
            (pays([n for n in current if n != name], current, by_name[name]), name)
            for name in current
            if name not in fixed and name not in needed
        ]
        worst = min(losses, default=(1.0, ""))
        if worst[0] > 0.0:
            return current
        current.remove(worst[1])
