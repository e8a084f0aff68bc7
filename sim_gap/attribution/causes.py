"""From fitted terms to causes: one cause per effect, ordered by how far each lowers the gap on held-out data."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gcomp.arrays import Array
from sim_gap.attribution.diagnosis import HINT, Cause, Signs
from sim_gap.attribution.rivals import LawTest, Rivals, separating_motion
from sim_gap.attribution.verdict import FOUNDED, confidence
from sim_gap.effects.registry import effects
from sim_gap.residuals.layout import Row
from sim_gap.residuals.residual_set import SLIGHT_NM, ResidualSet
from sim_gap.search.estimate import EffectEstimate, Value
from sim_gap.search.term import Term
from sim_gap.search.term_equations import TermEquations


@dataclass(frozen=True)
class CauseStep:
    """One effect added to the earlier ones: RMS per joint before and after, (n,)."""

    effect: str
    terms: tuple[Term, ...]
    below: tuple[Term, ...]
    """Terms of the earlier steps."""
    before: Array
    after: Array

    @property
    def fall(self) -> float:
        """Largest decrease at a joint [N·m]."""
        return float(np.max(self.before - self.after))


class _Scorer:
    def __init__(self, estimate: EffectEstimate, heldout: ResidualSet) -> None:
        self.estimate, self.heldout = estimate, heldout
        self.equations = TermEquations(estimate.on(heldout), estimate.terms, estimate.equations)
        self.joint = np.array([row[1] for row in self.equations.rows])
        self.counts = self.equations.seen

    def squares(self, terms: list[Term]) -> Array:
        """Held-out mean square per row after fitting these terms to the training set, (R,)."""
        return self.equations.linear.mean_squares(self.estimate.subset(terms))

    def signs(self, terms: tuple[Term, ...], evidence: float, outside: float) -> Signs:
        """The evidence for and against a cause, on the row that increases most without its terms."""
        data, rows = self.heldout, self.equations.rows
        final = self.squares(list(self.estimate.terms))
        without = self.squares([term for term in self.estimate.terms if term not in terms])
        raw = np.maximum(self.squares([]), final)
        r = int(np.argmax(np.where(self.counts, np.sqrt(without) - np.sqrt(final), -np.inf)))
        floor = np.array([data.floor[row] for row in rows])
        above = np.maximum(final - floor**2, 0.0)
        gaps = self.counts & (np.sqrt(raw) > np.array([data.margin[row] for row in rows]))
        elsewhere = float(np.mean(above[gaps] / raw[gaps])) if gaps.any() else 0.0
        excess = float(np.sqrt(final[r])) / data.relevance_floor[rows[r]]
        return Signs(evidence, float(above[r] / max(raw[r], 1e-12)), excess, elsewhere, outside)

    @cached_property
    def noise(self) -> Array:
        """Mean square of the noise in each row: of its floor, but at most of the residual of all terms, (R,)."""
        floor = np.array([self.heldout.floor[row] for row in self.equations.rows])
        return np.asarray(np.minimum(floor**2, self.squares(list(self.estimate.terms))))

    def rms(self, terms: list[Term]) -> Array:
        """Held-out RMS per joint after fitting these terms to the training set, (n,)."""
        return self._by_joint(self.squares(terms))

    def falls(self, terms: Sequence[Term], more: Sequence[Term], by_row: bool) -> Array:
        """Decrease of each joint's RMS by `more` in addition to `terms`, (n,); `by_row`, and at a joint whose command
        passes over noisy channels, the largest of one row, noise subtracted."""
        layout = self.heldout.layout
        before, after = (self.squares([*chosen]) for chosen in (terms, [*terms, *more]))
        whole = self._by_joint(before) - self._by_joint(after)
        before, after = (np.sqrt(np.maximum(squares - self.noise, 0.0)) for squares in (before, after))
        out = np.zeros(layout.n)
        np.maximum.at(out, self.joint[self.counts], (before - after)[self.counts])
        noisy = np.array([by_row or layout.beyond(joint) > 0 for joint in range(layout.n)])
        return np.where(noisy, out, whole)

    def taken(self, terms: Sequence[Term]) -> Array:
        """RMS of what these terms make of the whole fit at each joint, (n,)."""
        out = np.zeros(self.heldout.layout.n)
        for row, values in self.estimate.predict(self.heldout, terms=tuple(terms)).items():
            valid = self.heldout.valid[row]
            out[row[1]] = max(out[row[1]], float(np.sqrt(np.mean(values[valid] ** 2))) if valid.any() else 0.0)
        return out

    def missed(self, terms: Sequence[Term]) -> float:
        """Largest increase of a joint's RMS without these terms, the others fitted again [N·m]."""
        rest = [term for term in self.estimate.terms if term not in terms]
        return float(np.max(self.rms(rest) - self.rms(list(self.estimate.terms))))

    def _by_joint(self, squares: Array) -> Array:
        out = np.zeros(self.heldout.layout.n)
        np.add.at(out, self.joint[self.counts], squares[self.counts])
        return np.asarray(np.sqrt(out))


def order_of_effects(estimate: EffectEstimate, scorer: _Scorer) -> list[CauseStep]:
    """Effects in the order in which each, after the earlier ones, lowers some held-out RMS most, its own at most."""
    groups: dict[str, list[Term]] = defaultdict(list)
    for term in estimate.terms:
        groups[_belongs(term, estimate.terms, scorer.heldout.layout.n - 1)].append(term)
    chosen: list[Term] = []
    before, steps = scorer.rms([]), []
    most = {effect: scorer.taken(terms) for effect, terms in groups.items()}
    while groups:
        outcomes = {effect: scorer.rms([*chosen, *terms]) for effect, terms in groups.items()}
        effect = max(outcomes, key=lambda name: float(np.max(np.minimum(before - outcomes[name], most[name]))))
        steps.append(CauseStep(effect, tuple(groups.pop(effect)), tuple(chosen), before, outcomes[effect]))
        chosen += steps[-1].terms
        before = outcomes[effect]
    return steps


def _belongs(term: Term, terms: Sequence[Term], tip: int) -> str:
    """The effect that a term is attributed to: with a payload, the inertia of the last link is the payload's."""
    loaded = any(other.effect == "link.payload" for other in terms)
    inertia_of_payload = loaded and term.effect == "link.inertia" and term.place == tip
    return "link.payload" if inertia_of_payload else term.effect


MINOR = 0.6
"""Share of the smallest relevant gap of the rows in which it shows by which a cause must lower some joint's RMS not to
be minor."""


def relevant_terms(
    step: CauseStep, estimate: EffectEstimate, heldout: ResidualSet, scorer: _Scorer, within: bool
) -> tuple[Term, ...]:
    """Those of a step's terms that matter: a sound arm has less of them, and without the others together no joint's RMS
    rises by a relevant amount.

    A step as a whole matters if it lowers some RMS so far, in its place or as the last of all: an effect whose part
    others take as well as they can, such as load-dependent friction, shows in what they leave.
    """
    hit = heldout.impacts | estimate.store.data.impacts
    if any(
        not _is_held_out(term, heldout) or (term.effect == "transmission.backlash" and term.place in hit)
        for term in step.terms
    ):
        return step.terms
    shows = {row for term in step.terms for row in estimate.store.columns(term)}
    absolute = heldout.least(SLIGHT_NM) if within else heldout.relevant_nm
    least = np.maximum(MINOR * max(map(heldout.relevant, shows)) * heldout.usual_torque, absolute)
    by_row = within or {channel for channel, _ in shows} == {heldout.layout.command}

    def rise(gone: set[int]) -> Array:
        """RMS lost without the effect there; or that it takes in its place, if a later cause takes that too."""
        lost = [term for term in step.terms if term.place in gone]
        kept = [[term for term in terms if term not in lost] for terms in (estimate.terms, [*step.below, *step.terms])]
        last, first = (scorer.falls(terms, lost, by_row) for terms in kept)
        return np.maximum(last, np.minimum(first, scorer.taken(lost)))

    unusual = [term for term in step.terms if not estimate.is_usual(term)]
    places, small = {term.place for term in unusual}, set[int]()
    if np.all(rise(places) < least):
        return ()
    for place in sorted(places, key=lambda place: float(np.max(rise({place}) / least))):
        if np.all(rise({*small, place}) < least):
            small.add(place)
    return tuple(term for term in unusual if term.place not in small) or tuple(unusual)


def causes(
    estimate: EffectEstimate,
    heldout: ResidualSet,
    rivals: Rivals,
    names: tuple[str, ...],
    within: bool = False,
) -> tuple[list[Cause], list[Cause]]:
    """The causes, most important first, and the minor ones: whole effects, and joints at which an effect is small.

    If all rows are `within` their margins, noise could explain everything: a cause that may be nothing, by its own
    intervals, is minor, too, and so is a guess without rivals, which would share its evidence.
    """
    found: list[Cause] = []
    minor: list[Cause] = []
    scorer = _Scorer(estimate, heldout)
    fitted = _Scorer(estimate, estimate.store.data)
    law_test = LawTest(estimate.store, estimate.terms)
    hints: list[Term] = []
    for step in order_of_effects(estimate, scorer):
        main = relevant_terms(step, estimate, heldout, scorer, within)
        if within and all(estimate.may_be_nothing(term) for term in main):
            main = ()
        rest = tuple(term for term in step.terms if term not in main)
        for terms, out in ((main, found), (rest, minor)):
            if terms:
                bound = not any(_is_held_out(term, heldout) for term in terms)
                out.append(_cause(step, terms, fitted if bound else scorer, (rivals, law_test), names))
                hints += terms if out is found and out[-1].confidence < HINT else ()
    missed = max(one.missed(hints) for one in (scorer, fitted))
    found = [replace(each, fall=min(each.fall, missed)) if each.confidence < HINT else each for each in found]
    guesses = [cause for cause in found if within and not (cause.confounded_with or cause.confidence >= FOUNDED)]
    return [cause for cause in found if cause not in guesses], [*minor, *guesses]


def _is_held_out(term: Term, heldout: ResidualSet) -> bool:
    return any(term.present(s.number) for s in heldout.signals)


def _cause(
    step: CauseStep, terms: tuple[Term, ...], scorer: _Scorer, against: tuple[Rivals, LawTest], names: tuple[str, ...]
) -> Cause:
    """One cause from terms of a step, compared with the rest of the library and with the general laws."""
    rivals, law_test = against
    places = sorted({term.place for term in terms})
    whole = effects()[step.effect].signature.whole_arm
    touched = np.arange(len(names)) if whole else np.array(places)
    evidence, confounded = rivals.weigh(step.effect, terms)
    outside, law = law_test.best_law(terms)
    signs = scorer.signs(terms, evidence, outside)
    parameters: dict[str, dict[str, Value]] = {}
    for term in sorted(terms, key=lambda t: t.place):
        parameters.setdefault("arm" if whole else names[term.place], {}).update(scorer.estimate.parameters(term))
    return Cause(
        effect=step.effect,
        joints=names if whole else tuple(names[place] for place in places),
        parameters=parameters,
        gap_before=float(np.sqrt(np.mean(step.before[touched] ** 2))),
        gap_after=float(np.sqrt(np.mean(step.after[touched] ** 2))),
        confidence=confidence(signs, len(confounded)),
        fall=step.fall,
        signs=signs,
        confounded_with=confounded,
        separate_by=separating_motion(step.effect, confounded),
        law=law,
    )


def remainder(data: ResidualSet, explained: dict[Row, Array]) -> dict[Row, Array]:
    """Residual less the sum of the terms, (K,) per row."""
    return {row: values - explained[row] for row, values in data.values.items()}
