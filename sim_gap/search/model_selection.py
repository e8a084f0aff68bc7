"""Model selection: search the library, search again if simpler effects may suffice, refine the shapes."""

from collections import Counter
from collections.abc import Sequence
from operator import itemgetter

import numpy as np
from scipy.optimize import minimize_scalar

from gcomp.estimate.choice import EXCHANGED
from gcomp.estimate.linear_terms import PRICE
from sim_gap.effects.effect import Key
from sim_gap.effects.registry import effects
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.estimate import SHAPE_STEP, SYSTEMATIC
from sim_gap.search.gauss_newton import Values, converge
from sim_gap.search.term import CONSTANT, MASSES, OF_LINKS, Term
from sim_gap.search.term_equations import TermChoice, TermEquations


def one_cause_of_gravity(store: ColumnStore, choice: TermChoice, offered: Sequence[Term]) -> list[list[Term]]:
    """The chosen terms with one effect in place of the mass moments of several links, for the two effects that explain
    most, about the nominal model; none if that is no question.

    A body at the tip, a joint's zero that is off or a base that leans change gravity at several joints, much as mass
    moments of several links do. Linear in what is small, each of them fits a little worse than these, and no exchange
    of one for one leads back.
    """
    rest = [term for term in choice.current if term.effect != MASSES]
    if len(choice.current) - len(rest) < 2:
        return []
    about = TermChoice(TermEquations(store, list(dict.fromkeys([*rest, *offered]))), rest)
    others = [term for term in about.equations.terms if term not in about.current and term.effect != MASSES]
    trials = [about.with_needs(term, rest) for term in about.shortlist(rest, others, EXCHANGED)]
    return sorted((trial for trial in trials if np.isfinite(about.judge(trial))), key=about.judge)[:2]


def every_constant(choice: TermChoice, offered: Sequence[Term]) -> list[Term]:
    """Every drive's torque constant free, the links as in the model, all else as chosen; none if neither a constant nor
    a mass is chosen.

    Where motor torque alone is recorded, one drive's constant is as doubtful as another's. A search that adds one
    effect after the other may end with one constant as the model has it, or all, and masses changed in proportion.
    """
    chosen = {term.effect for term in choice.current}
    if choice.equations.layout.sensor is not None or chosen.isdisjoint((CONSTANT, MASSES)):
        return []
    drives = [term for term in offered if term.effect == CONSTANT]
    return [*drives, *(term for term in choice.current if term.effect not in (CONSTANT, *OF_LINKS))]


def select_model(store: ColumnStore, library: Sequence[str]) -> TermChoice:
    """Search the library, refine the shapes of the selected terms, and drop those that no longer earn their place.

    A search ends where no single step helps; what others found that began elsewhere is among the choice's `others`.
    """
    offered, chosen = first_search(store, library)
    store.keep(offered)
    choice = search_again(store, chosen, offered)
    starts = one_cause_of_gravity(store, choice, offered)
    found = [(each.score, each) for each in [choice, *(search_again(store, start, offered) for start in starts)]]
    choice = min(found, key=itemgetter(0))[1]
    if start := every_constant(choice, offered):
        again = search_again(store, start, offered, frozenset({CONSTANT}))
        together = PRICE * effects()[CONSTANT].plausibility.prior_penalty  # of one effect that few arms have
        found.append((again.score + together, again))
    least, choice = min(found, key=itemgetter(0))
    for held in (store, choice.equations.store):  # frees the columns of rivals and of the estimate before
        held.keep(choice.current)
    choice.others = [(score - least, other.current) for score, other in found if other is not choice]
    return choice


def search_again(
    store: ColumnStore, chosen: Sequence[Term], offered: Sequence[Term], usual: frozenset[str] = frozenset()
) -> TermChoice:
    """The terms offered, searched with columns about the fit of those that are chosen, until both agree."""
    terms = refine(store, first_of_each(chosen))
    values: Values = {}
    for _ in range(ROUNDS):
        about, terms = converge(store, terms, values)
        refined = refine(about, terms)
        if refined != terms:
            about, terms = converge(store, refined, about.values)
        keys = {term.key for term in terms}
        others = [term for term in offered if term.key not in keys]
        equations = TermEquations(about, [*terms, *relinearised_in_place(about, terms, others)])
        choice = TermChoice(equations, terms, usual, AGAIN * equations.measurements)
        choice.run()
        if {term.key for term in choice.current} == keys:
            break
        terms, values = first_of_each(choice.current), about.values
    return choice


def first_search(store: ColumnStore, library: Sequence[str]) -> tuple[list[Term], list[Term]]:
    """The terms that are offered to the search about the estimate, and those that a search about the nominal model
    selects."""
    choice = TermChoice(TermEquations(store, candidates(store.data, library)))
    choice.run()
    return likely_shapes(choice), choice.current


AGAIN = -0.5 * float(np.log(1.0 - (2.0 * SYSTEMATIC) ** 2))
"""Least fall of the score, per independent measurement, by a term that only a search about the estimate adds: of one
row's residual, what no model has can mimic the best of many effects up to the share 2 SYSTEMATIC."""
SHAPES = 3
"""Number of shapes of an effect at one place that are evaluated about the estimate."""
ROUNDS = 3
"""How often the library is searched again about the estimate."""


def candidates(data: ResidualSet, library: Sequence[str]) -> list[Term]:
    """Every effect of the library at every place and starting shape that these channels can show."""
    layout = data.layout
    every = (
        Term(name, place, shape)
        for name in library
        for place in effects()[name].signature.places(layout)
        for shape in effects()[name].hints.grid(data.signals, place)
    )
    return list(dict.fromkeys(every))  # a joint that rests has one level where others have several


def likely_shapes(choice: TermChoice) -> list[Term]:
    """The terms of a choice, of each effect and place only the SHAPES that would help most beside the chosen ones."""
    rest = [term for term in choice.equations.terms if term not in choice.current]
    falls = choice.terms.promises(choice.free(choice.current), [choice.effects[term].parameters for term in rest])
    count = Counter[Key]()
    kept = {*choice.current}
    for k in np.argsort(-falls).tolist():
        count[rest[k].key] += 1
        if count[rest[k].key] <= SHAPES:
            kept.add(rest[k])
    return [term for term in choice.equations.terms if term in kept]


def first_of_each(terms: Sequence[Term]) -> list[Term]:
    """The terms as they are reported where several show alike, only the first of each effect and place: two shapes
    approximate one between them."""
    terms = [Term(term.effect, *term.form.hints.canonical(term.place, term.shape)) for term in terms]
    return list({term.key: term for term in reversed(terms)}.values())[::-1]


def refine(store: ColumnStore, active: list[Term]) -> list[Term]:
    """Move each shape, in its best form, to the best fit between its neighbours on the grid."""
    out = list(active)
    for _ in range(3):
        out = relinearised(store, out)
    for term in list(out):
        found = _between(store.data, term)
        if found is None:
            continue
        free, low, high = found

        def fit(other: Term, term: Term = term) -> float:
            equations = TermEquations(store, [other if each == term else each for each in out])
            return equations.log_squares(equations.linear.fit(equations.index(equations.terms).tolist()))

        def best(form: Term, low: float, high: float, free: int = free) -> Term:
            options = {"xatol": SHAPE_STEP * (high - low)}
            own = minimize_scalar(
                lambda x: fit(form.reshaped(free, x)), bounds=(low, high), method="bounded", options=options
            )
            return form.reshaped(free, float(own.x))

        size = term.shape[free]
        forms = [Term(*term.key, shape) for shape in term.form.hints.forms(term.shape) if shape != term.shape]
        trials = [term, best(term, low, high), *(best(form, 0.5 * size, 1.5 * size) for form in forms)]
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
    return [term.relinearised(c) for term, c in TermEquations(store, active).fitted().items()]


def relinearised_in_place(store: ColumnStore, chosen: list[Term], offered: list[Term]) -> list[Term]:
    """The terms offered, nonlinear effects linearised at the size that they have in place of a chosen term."""
    for _ in range(2):
        nonlinear = [term for term in offered if term.form.hints.linearised_at is not None]
        if not nonlinear or not chosen:
            return offered
        choice = TermChoice(TermEquations(store, [*chosen, *nonlinear]), chosen)
        best: dict[Term, tuple[float, Term]] = {}
        for term in choice.current:
            rest = choice.without(term, choice.current)
            for other in choice.shortlist(rest, [t for t in nonlinear if t in choice.effects], 1):
                terms = choice.with_needs(other, rest)
                score = choice.judge(terms)
                if score < best.get(other, (np.inf, other))[0]:
                    best[other] = score, other.relinearised(choice.values(terms)[other])
        offered = [best[term][1] if term in best else term for term in offered]
    return offered
