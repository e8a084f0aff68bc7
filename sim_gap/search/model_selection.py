"""The competition as a whole: search the library, search again where simpler effects may do, refine the shapes."""

from collections.abc import Callable, Sequence

import numpy as np

from sim_gap.effects.registry import effects
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.normal_equations import ColumnStore, Normal, Term, Weighted
from sim_gap.search.stepwise import TRIES, Search, shortlist


def compete(store: ColumnStore, library: Sequence[str]) -> Search:
    """Search the library, refine the shapes of what was chosen, and drop what no longer earns its place."""
    offered = candidates(store.data, library)
    first = Search(Normal(store, offered))
    first.run()
    chosen = refine(store, one_each([named(term) for term in without_doubtful(first).active]))
    keys = {term.key for term in chosen}
    rivals = in_place(store, chosen, [term for term in offered if term.key not in keys])
    search = Search(Normal(store, [*chosen, *rivals]), chosen)
    while search.backward():
        pass
    return search


def candidates(data: ResidualSet, library: Sequence[str]) -> list[Term]:
    """Every effect of the library at every place and starting shape that these channels can show."""
    layout = data.layout
    return [
        Term(name, place, shape)
        for name in library
        for place in effects()[name].places(layout)
        for shape in effects()[name].grid(data.signals, place)
    ]


def named(term: Term) -> Term:
    """The term by which one is named that shows exactly alike."""
    return Term(term.effect, *effects()[term.effect].settled(term.place, term.shape))


def one_each(terms: Sequence[Term]) -> list[Term]:
    """The terms, of one effect at one place the first: two shapes of it stand for one between them, to be refined."""
    return list({term.key: term for term in reversed(terms)}.values())[::-1]


def without_doubtful(search: Search) -> Search:
    """Search again from where terms that leave much on their rows have given way to the simpler ones they are made of.

    One step at a time does not get there where these need company to do better.
    """
    layout, library = search.normal.layout, effects()
    made = {t: library[t.effect].made_of(layout, t.place, t.shape) for t in search.active}
    doubtful = [term for term, parts in made.items() if parts and search.leaves_much(term)]
    if not doubtful:
        return search
    rest = search.active
    for term in doubtful:
        rest = search.without(term, rest)
    wanted = {key for term in doubtful for key in made[term]} - {other.key for other in rest}
    again = Search(search.normal, [*rest, *(other for other in search.normal.terms if other.key in wanted)])
    again.added.update({term.key: TRIES - 1 for term in doubtful})
    again.run()
    return again if again.score < search.score - 1e-3 else search


def refine(store: ColumnStore, active: list[Term]) -> list[Term]:
    """Move each shape between its neighbours of the starting grid to where the fit is best (golden section)."""
    out = list(active)
    for _ in range(3):
        out = secants(store, out)
    for term in list(out):
        found = _between(store.data, term)
        if found is None:
            continue
        free, low, high = found

        def fit(value: float, term: Term = term, free: int = free) -> float:
            trial = [term.reshaped(free, value) if other == term else other for other in out]
            normal = Normal(store, trial)
            start = normal.square.sum(0) / np.maximum(normal.count.sum(0), 1.0)
            squares = normal.mean_square(*Weighted(normal, start).fit(normal.terms))
            return float(0.5 * np.log(squares + normal.floor**2)[normal.seen].sum())

        value = golden(fit, low, high)
        if fit(value) < fit(term.shape[free]):
            out[out.index(term)] = term.reshaped(free, value)
    return out


def _between(data: ResidualSet, term: Term) -> tuple[int, float, float] | None:
    """The free entry of a term's shape and its neighbours on the starting grid; None where there is none."""
    free = term.free
    if free is None:
        return None
    grid = sorted({shape[free] for shape in effects()[term.effect].grid(data.signals, term.place)})
    value = term.shape[free]
    lower, upper = [x for x in grid if x < value - 1e-9], [x for x in grid if x > value + 1e-9]
    beyond = sorted((0.5 * value, 1.5 * value))
    return free, (lower[-1] if lower else beyond[0]), (upper[0] if upper else beyond[1])


def secants(store: ColumnStore, active: list[Term]) -> list[Term]:
    """Take the secant of every curved effect at its fitted size."""
    if not any(effects()[term.effect].secant for term in active):
        return active
    normal = Normal(store, active)
    search = Search(normal, list(normal.terms))
    _, values = search.weighted.fit(normal.terms)

    def settled(term: Term) -> Term:
        effect = effects()[term.effect]
        shape = effect.resized(values[normal.at[term]], term.shape) if effect.secant else term.shape
        return Term(term.effect, term.place, shape)

    return [settled(term) for term in normal.terms]


def in_place(store: ColumnStore, chosen: list[Term], offered: list[Term]) -> list[Term]:
    """The terms offered, curved ones with their secants at the size that they take in the place of a chosen one."""
    for _ in range(2):
        curved = [term for term in offered if effects()[term.effect].secant]
        if not curved or not chosen:
            return offered
        search = Search(Normal(store, [*chosen, *curved]), list(chosen))
        best: dict[Term, tuple[float, Term]] = {}
        for term in search.active:
            rest = search.without(term, search.active)
            for _, other in shortlist(search.weighted.screen(rest, curved))[:2]:
                terms = search.with_beneath(other, rest)
                score = search.judge(terms)
                if score < best.get(other, (np.inf, other))[0]:
                    index, values = search.weighted.fit(terms)
                    own = values[np.isin(index, search.normal.at[other])]
                    best[other] = (
                        score,
                        Term(other.effect, other.place, effects()[other.effect].resized(own, other.shape)),
                    )
        offered = [best[term][1] if term in best else term for term in offered]
    return offered


def golden(function: Callable[[float], float], low: float, high: float, steps: int = 10) -> float:
    """Minimum of a function between two values by golden-section search."""
    ratio = 0.5 * (np.sqrt(5.0) - 1.0)
    a, b = high - ratio * (high - low), low + ratio * (high - low)
    fa, fb = function(a), function(b)
    for _ in range(steps):
        if fa < fb:
            high, b, fb = b, a, fa
            a = high - ratio * (high - low)
            fa = function(a)
        else:
            low, a, fa = a, b, fb
            b = low + ratio * (high - low)
            fb = function(b)
    return float(0.5 * (low + high))
