"""Model selection: search the library, search again if simpler effects may suffice, refine the shapes."""

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from sim_gap.effects.effect import Key
from sim_gap.effects.registry import effects
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.estimate import SYSTEMATIC
from sim_gap.search.gauss_newton import Values, converge
from sim_gap.search.normal_equations import NormalEquations, Weighted
from sim_gap.search.stepwise_search import TRIES, StepwiseSearch, impossible_terms, shortlist
from sim_gap.search.term import Term
from sim_gap.search.torque_constants import CONSTANTS, drives_are_off, every_constant, most_are_off, price_of_all

MOMENTS, BODY = "link.mass_moment", "link.payload"
SURE_FRICTION = ("friction.coulomb", "friction.viscous")
"""Effects that every joint has."""


def one_body(store: ColumnStore, search: StepwiseSearch, offered: Sequence[Term]) -> list[Term] | None:
    """The active terms with a payload in place of the mass moments, if that fits as well about itself; else None.

    Linear in its mass and first moment, a payload lacks the inertia that its mass has where it hangs; mass moments of
    all links together then fit a little better, and no single exchange leads back. `store` has the columns about the
    nominal model.
    """
    active = search.active
    bodies = [term for term in offered if term.effect == BODY and not term.shape]
    moments = [term for term in active if term.effect == MOMENTS]
    if len(moments) < 2 or not bodies or any(term.effect == BODY for term in active):
        return None
    about, kept = converge(store, [*(term for term in active if term not in moments), bodies[0]])
    found = StepwiseSearch(NormalEquations(about, kept), kept)
    there = any(term.effect == BODY for term in found.active)
    return found.active if there and found.score < search.score else None


def select_model(store: ColumnStore, library: Sequence[str]) -> StepwiseSearch:
    """Search the library, refine the shapes of the selected terms, and drop those that no longer earn their place."""
    offered, active = first_search(store, library)
    store.keep(offered)
    search = search_again(store, active, offered)
    if (body := one_body(store, search, offered)) is not None:
        again = search_again(store, body, offered)
        search = again if again.score < search.score else search
    if drives_are_off(search):
        again = search_again(store, every_constant(search, offered), offered, CONSTANTS)
        better = again.score + price_of_all(again) < search.score
        search = again if better and most_are_off(again) else search
    for held in (store, search.normal.store.beside(None)):  # frees the columns of rivals and of the estimate before
        held.keep(search.active)
    return search


def search_again(
    store: ColumnStore, active: Sequence[Term], offered: Sequence[Term], usual: frozenset[str] = frozenset()
) -> StepwiseSearch:
    """The terms offered, searched about the fit of those that are active, until both agree."""
    chosen = refine(store, first_of_each([canonical_term(term) for term in active]))
    values: Values = {}
    near: ColumnStore | None = None
    rounds = 0
    for _ in range(MOST_ROUNDS):
        search = refit_about_itself(store, chosen, offered, values, near, usual)
        keys = {term.key for term in search.active}
        gone = {term.key for term in chosen} - keys
        if rounds == ROUNDS and not gone:
            break
        rounds += not gone
        offered = [term for term in offered if gone.isdisjoint({term.key, *term.beneath})]  # cannot exist about itself
        search.added.update(dict.fromkeys(gone, TRIES))
        search.least = AGAIN
        search.run()
        if {term.key for term in search.active} == keys:
            break
        near = search.normal.store
        values = near.values
        chosen = first_of_each([canonical_term(term) for term in search.active])
    return search


def first_search(store: ColumnStore, library: Sequence[str]) -> tuple[list[Term], list[Term]]:
    """The terms that are offered to the search about the estimate, and those that a search about the nominal model
    selects: one that begins with nothing, and one with the friction that every arm has. Of an arm that swings free,
    dry and viscous friction explain the torque together, and neither does alone.
    """
    normal = NormalEquations(store, candidates(store.data, library))
    friction = [term for term in normal.terms if term.effect in SURE_FRICTION]
    starts = [StepwiseSearch(normal), StepwiseSearch(normal, friction)]
    for start in starts:
        start.run()
    search = replace_doubtful(min(starts, key=lambda start: start.score))
    return likely_shapes(search), search.active


def refit_about_itself(
    nominal: ColumnStore,
    chosen: list[Term],
    offered: Sequence[Term],
    start: Values,
    near: ColumnStore | None = None,
    usual: frozenset[str] = frozenset(),
) -> StepwiseSearch:
    """The chosen terms and their rivals with columns evaluated about the fit of the chosen ones, from coefficients
    `start` on. `near` is the store of an earlier fit, whose columns of rivals serve if it is close."""
    store, chosen = restore_lost(nominal, chosen, *converge(nominal, chosen, start))
    refined = refine(store, chosen)
    if refined != chosen:
        again, kept = converge(nominal, refined, store.values)
        if len(kept) == len(refined):  # all can exist about themselves
            store, chosen = again, kept
    store = store.beside(near)
    keys = {term.key for term in chosen}
    others = [term for term in set_levels(store, offered) if term.key not in keys]
    rivals = relinearised_in_place(store, chosen, others)
    return StepwiseSearch(NormalEquations(store, [*chosen, *rivals]), chosen, usual=usual)


def restore_lost(
    nominal: ColumnStore, wanted: Sequence[Term], store: ColumnStore, chosen: list[Term]
) -> tuple[ColumnStore, list[Term]]:
    """A fit of the `chosen` terms with those of the `wanted` ones that cannot exist about themselves with their shape,
    but can with another."""
    lost = {term.key for term in wanted if term.free is not None} - {term.key for term in chosen}
    if not lost:
        return store, chosen
    grids = {key: effects()[key[0]].hints.grid(store.data.signals, key[1]) for key in lost}
    shapes = [Term(*key, shape) for key, grid in grids.items() for shape in grid]
    needed = {key for term in shapes for key in term.beneath} - {term.key for term in chosen} - lost
    beneath = [term for term in wanted if term.key in needed]
    search = StepwiseSearch(NormalEquations(store, [*chosen, *shapes, *beneath]), chosen)
    search.take_back(lost)
    return converge(nominal, search.active, store.values) if len(search.active) > len(chosen) else (store, chosen)


def set_levels(store: ColumnStore, offered: Sequence[Term]) -> list[Term]:
    """The terms offered, with levels of limits, plays and dead bands from the torques about an estimate."""
    other, signals = store.other_torques, [one.signals for one in store.about]

    def follows(term: Term) -> bool:
        return term.form.signature.side == "distortion" and term.free is not None and bool(other[term.place])

    keys = dict.fromkeys(term.key for term in offered if follows(term))
    levels = [Term(name, j, shape) for name, j in keys for shape in effects()[name].hints.grid(signals, j)]
    return [*(term for term in offered if not follows(term)), *levels]


AGAIN = -0.5 * float(np.log(1.0 - SYSTEMATIC**2))
"""Least improvement of the score by a term that only a search about the estimate adds: of one row's residual, what no
model has can mimic an effect up to the share SYSTEMATIC, and such an effect lowers ½ log R² by this."""
SHAPES = 3
"""Number of shapes of an effect at one place that are evaluated about the estimate."""
ROUNDS, MOST_ROUNDS = 2, 5
"""How often the library is searched again about the estimate; more often where terms of a search turn out to be
impossible about themselves."""


def candidates(data: ResidualSet, library: Sequence[str]) -> list[Term]:
    """Every effect of the library at every place and starting shape that these channels can show."""
    layout = data.layout
    return [
        Term(name, place, shape)
        for name in library
        for place in effects()[name].signature.places(layout)
        for shape in effects()[name].hints.grid(data.signals, place)
    ]


def likely_shapes(search: StepwiseSearch) -> list[Term]:
    """The terms of a search, of each effect and place only the SHAPES that would help most beside the active ones."""
    rest = [term for term in search.normal.terms if term not in search.active]
    count = Counter[Key]()
    kept = list(search.active)
    for _, term in search.weighted.screen(search.active, rest):
        count[term.key] += 1
        if count[term.key] <= SHAPES:
            kept.append(term)
    return [term for term in search.normal.terms if term in set(kept)]


def canonical_term(term: Term) -> Term:
    """The term under which one is reported, of those that show exactly alike."""
    return Term(term.effect, *term.form.hints.canonical(term.place, term.shape))


def first_of_each(terms: Sequence[Term]) -> list[Term]:
    """The terms, only the first of each effect and place: two shapes approximate one between them."""
    return list({term.key: term for term in reversed(terms)}.values())[::-1]


def replace_doubtful(search: StepwiseSearch) -> StepwiseSearch:
    """Search again with terms that leave a large residual on their rows replaced by their simpler alternatives.

    Single steps do not get there if several alternatives are needed at once.
    """
    parts = {term: term.alternatives(search.normal.layout) for term in search.active}
    doubtful = [term for term, simpler in parts.items() if simpler and search.leaves_much(term)]
    if not doubtful:
        return search
    rest = search.active
    for term in doubtful:
        rest = search.without(term, rest)
    wanted = {key for term in doubtful for key in parts[term]} - {other.key for other in rest}
    again = StepwiseSearch(search.normal, [*rest, *(other for other in search.normal.terms if other.key in wanted)])
    again.added.update({term.key: TRIES - 1 for term in doubtful})
    again.run()
    return again if again.score < search.score - 1e-3 else search


def refine(store: ColumnStore, active: list[Term]) -> list[Term]:
    """Move each shape, in its best form, to the best fit between its neighbours on the grid (golden section).

    A shape at which the term cannot exist is left for one at which it can: a limit fits best where too little is cut
    off.
    """
    out = list(active)
    for _ in range(3):
        out = relinearised(store, out)
    for term in list(out):
        found = _between(store.data, term)
        if found is None:
            continue
        free, low, high = found

        def fit(other: Term, term: Term = term) -> float:
            normal = NormalEquations(store, [other if each == term else each for each in out])
            start = normal.square.sum(0) / np.maximum(normal.count.sum(0), 1.0)
            index, coefficients = Weighted(normal, start).fit(normal.terms)
            if other in impossible_terms(normal, normal.terms, coefficients):
                return float("inf")
            squares = normal.mean_square(index, coefficients)
            return float(0.5 * np.log(squares + normal.floor**2)[normal.seen].sum())

        def best(form: Term, low: float, high: float, free: int = free) -> Term:
            return form.reshaped(free, golden_section(lambda value: fit(form.reshaped(free, value)), low, high))

        size = term.shape[free]
        trials = [term, best(term, low, high), *(best(form, 0.5 * size, 1.5 * size) for form in term.forms)]
        out[out.index(term)] = min(trials, key=fit)
    return out


def _between(data: ResidualSet, term: Term) -> tuple[int, float, float] | None:
    """The free entry of a term's shape, and the neighbours on the starting grid of the value there that is closest to
    its own, which levels about an estimate may miss by a little; None if it has none."""
    free = term.free
    if free is None:
        return None
    grid = sorted({shape[free] for shape in term.form.hints.grid(data.signals, term.place)})
    value = term.shape[free]
    closest = int(np.argmin(np.abs(np.array(grid) - value)))
    lower, upper = grid[:closest], grid[closest + 1 :]
    beyond = sorted((0.5 * value, 1.5 * value))
    return free, lower[-1] if lower else beyond[0], upper[0] if upper else beyond[1]


def relinearised(store: ColumnStore, active: list[Term]) -> list[Term]:
    """The terms, nonlinear effects linearised at their fitted size."""
    if all(term.form.hints.linearised_at is None for term in active):
        return active
    normal = NormalEquations(store, active)
    search = StepwiseSearch(normal, list(normal.terms))
    _, values = search.weighted.fit(normal.terms)
    return [term.relinearised(values[normal.at[term]]) for term in normal.terms]


def relinearised_in_place(store: ColumnStore, chosen: list[Term], offered: list[Term]) -> list[Term]:
    """The terms offered, nonlinear effects linearised at the size that they have in place of a chosen term."""
    for _ in range(2):
        nonlinear = [term for term in offered if term.form.hints.linearised_at is not None]
        if not nonlinear or not chosen:
            return offered
        search = StepwiseSearch(NormalEquations(store, [*chosen, *nonlinear]), list(chosen))
        best: dict[Term, tuple[float, Term]] = {}
        for term in search.active:
            rest = search.without(term, search.active)
            for _, other in shortlist(search.weighted.screen(rest, nonlinear))[:2]:
                terms = search.with_beneath(other, rest)
                score = search.judge(terms)
                if score < best.get(other, (np.inf, other))[0]:
                    index, values = search.weighted.fit(terms)
                    own = values[np.isin(index, search.normal.at[other])]
                    best[other] = score, other.relinearised(own)
        offered = [best[term][1] if term in best else term for term in offered]
    return offered


def golden_section(function: Callable[[float], float], low: float, high: float, steps: int = 10) -> float:
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
