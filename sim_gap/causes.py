"""From fitted terms to causes: one entry an effect, ordered by what each brings on motion not fitted."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim_gap.confound import Rivals
from sim_gap.diagnosis import Cause
from sim_gap.effects.registry import Row
from sim_gap.estimate import Estimate, Value
from sim_gap.normal import ColumnStore, Normal, Term
from sim_gap.residual import CARE_NM, ResidualSet
from sim_gap.rigid import Array


@dataclass(frozen=True)
class Step:
    """One effect added to those before it: RMS per joint before and after, (n,)."""

    effect: str
    terms: tuple[Term, ...]
    before: Array
    after: Array

    @property
    def fall(self) -> float:
        """Largest fall on a joint [N·m]."""
        return float(np.max(self.before - self.after))


def ordered(estimate: Estimate, heldout: ResidualSet) -> list[Step]:
    """Effects in the order in which each, added to those before it, lowers the held-out RMS of some joint most."""
    groups: dict[str, list[Term]] = defaultdict(list)
    for term in estimate.terms:
        groups[_belongs(term, estimate.terms, heldout.layout.n - 1)].append(term)
    scorer = _Scorer(estimate, heldout)
    chosen: list[Term] = []
    before, steps = scorer.rms([]), []
    while groups:
        outcomes = {effect: scorer.rms([*chosen, *terms]) for effect, terms in groups.items()}
        effect = max(outcomes, key=lambda name: float(np.max(before - outcomes[name])))
        steps.append(Step(effect, tuple(groups.pop(effect)), before, outcomes[effect]))
        chosen += steps[-1].terms
        before = outcomes[effect]
    return steps


def _belongs(term: Term, terms: Sequence[Term], tip: int) -> str:
    """The effect that a term counts to: where there is a payload, its inertia is the payload's."""
    loaded = any(other.effect == "link.payload" for other in terms)
    inertia_of_payload = loaded and term.effect == "link.inertia" and term.place == tip
    return "link.payload" if inertia_of_payload else term.effect


class _Scorer:
    def __init__(self, estimate: Estimate, heldout: ResidualSet) -> None:
        self.estimate, self.heldout = estimate, heldout
        self.normal = Normal(ColumnStore(heldout), estimate.terms)
        self.joint = np.array([row[1] for row in self.normal.rows])
        self.counts = self.normal.count.sum(0) > 0

    def rms(self, terms: list[Term]) -> Array:
        """Held-out RMS per joint after fitting these terms on the training set, (n,)."""
        squares = self.normal.mean_square(np.arange(self.normal.size), self.estimate.subset(terms))
        out = np.zeros(self.heldout.layout.n)
        np.add.at(out, self.joint[self.counts], squares[self.counts])
        return np.asarray(np.sqrt(out))


MINOR, MINOR_INNER = 5e-3, 1.5e-3
"""Share of a joint's largest torque that a cause must lower some joint's RMS by, not to be minor; where the cause shows
against the model, and where only in motor against sensor or command."""


def is_minor(step: Step, estimate: Estimate, heldout: ResidualSet) -> bool:
    """Whether a step lowers no joint's RMS by what a user would care about."""
    shows = {channel for term in step.terms for channel, _ in estimate.store.columns(term)}
    share = MINOR if heldout.layout.against_model in shows else MINOR_INNER
    least = np.maximum(share * heldout.largest_torque, CARE_NM)
    return bool(np.all(step.before - step.after < least))


def causes(
    estimate: Estimate, heldout: ResidualSet, rivals: Rivals, names: tuple[str, ...]
) -> tuple[list[Cause], list[Cause]]:
    """The causes, most important first, and the minor ones."""
    found: list[Cause] = []
    minor: list[Cause] = []
    for step in ordered(estimate, heldout):
        places = sorted({term.place for term in step.terms})
        whole = rivals.whole_arm(step.effect)
        joints = names if whole else tuple(names[place] for place in places)
        touched = np.arange(len(names)) if whole else np.array(places)
        verdict = rivals.weigh(step.effect, step.terms)
        parameters: dict[str, dict[str, Value]] = {}
        for term in sorted(step.terms, key=lambda t: t.place):
            parameters.setdefault("arm" if whole else names[term.place], {}).update(estimate.parameters(term))
        (minor if is_minor(step, estimate, heldout) else found).append(
            Cause(
                effect=step.effect,
                joints=joints,
                parameters=parameters,
                gap_before=float(np.sqrt(np.mean(step.before[touched] ** 2))),
                gap_after=float(np.sqrt(np.mean(step.after[touched] ** 2))),
                confidence=verdict.confidence,
                fall=step.fall,
                confounded_with=verdict.confounded_with,
                separate_by=verdict.separate_by,
            )
        )
    return found, minor


def left_over(data: ResidualSet, explained: dict[Row, Array]) -> dict[Row, Array]:
    """Residual less what the terms explain, (K,) per row."""
    return {row: values - explained[row] for row, values in data.values.items()}
