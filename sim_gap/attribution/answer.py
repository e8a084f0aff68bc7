"""The answer of a diagnosis around its causes: verdict, gap before and after, roll-out, notes."""

from dataclasses import dataclass, replace

import numpy as np

from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.attribution.causes import remainder
from sim_gap.attribution.diagnosis import HINT, Cause, Diagnosis
from sim_gap.attribution.notes import aside_notes, law_notes, notes, worse_notes
from sim_gap.attribution.residual_laws import as_effects, residual_laws
from sim_gap.attribution.rollout import roll_out
from sim_gap.attribution.verdict import share_left, verdict
from sim_gap.model.load import SimModel
from sim_gap.residuals.disregarded_rows import fast_gaps, share_left_out, slides, slow_gaps
from sim_gap.residuals.location import by_joint, locate, row_rms
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.estimate import EffectEstimate


@dataclass(frozen=True, eq=False)
class Internals:
    """Model, data and fit behind a diagnosis, for report, roll-out and export."""

    model: SimModel
    train: ResidualSet
    heldout: ResidualSet
    estimate: EffectEstimate
    """Without a term if there is no gap."""
    recordings: tuple[Recording, ...]
    """Held-out recordings."""
    fitted: EffectEstimate
    """The fit even if there is no gap."""


def answer(made: Internals, found: list[Cause], minor: list[Cause], heldout_is: str) -> Diagnosis:
    """The diagnosis from its causes, the minor ones, and a description of the held-out data."""
    fit, judge, estimate = made.train, made.heldout, made.estimate
    explained = estimate.predict(judge)
    left, left_fit = remainder(judge, explained), remainder(fit, estimate.predict(fit))
    stuck = [each for s in (*fit.signals, *judge.signals) for each in s.stuck]
    sets = [(judge, left), *([(fit, left_fit)] if found else [])]
    friction = _dry_friction(made.model.arm.frictionloss, estimate)
    known = [row for row in fit.rows if slides(fit, row)]
    aside = [*slow_gaps(judge, explained, friction, known), *fast_gaps(judge, made.recordings)]
    laws = residual_laws(fit, judge, left_fit, left, friction)
    result = verdict(found, sets, unsettled=bool(laws) or any(place.clear for place in aside))
    if stuck or (fit.impacts and not any(cause.effect == "transmission.backlash" for cause in found)):
        result = "unexplained"
    hints = [replace(cause, confidence=min(cause.confidence, HINT)) for cause in found]
    shown = hints if result == "unexplained" else found
    levels = row_rms(judge), row_rms(judge, left), judge.margin, judge.floor
    before, after, margin, floor = (by_joint(judge, each) for each in levels)
    return Diagnosis(
        verdict=result,
        names=made.model.arm.names,
        where=(*locate(judge), *aside),
        left_out=share_left_out(judge),
        causes=tuple(shown),
        minor=tuple(minor),
        noise_floor=floor,
        train_before=by_joint(fit, row_rms(fit)),
        train_after=by_joint(fit, row_rms(fit, left_fit)),
        heldout_before=before,
        heldout_after=after,
        unexplained=share_left(judge, left),
        margin=margin,
        heldout_is=heldout_is,
        rollout=roll_out(made.model, judge, made.recordings, estimate, found, as_effects(laws, made.model.arm.names)),
        laws=tuple(laws),
        notes=(
            *notes(found, stuck, estimate, fit, judge, left),
            *worse_notes(made.model.arm.names, before, after, margin),
            *aside_notes(aside),
            *law_notes(laws, made.model.arm.names),
        ),
        internals=made,
    )


def _dry_friction(nominal: Array, estimate: EffectEstimate) -> Array:
    """Dry friction of the joints as far as it is known: the model's, and what was found beside it [N·m], (n,)."""
    friction = nominal.copy()
    for term in estimate.terms:
        if term.effect == "friction.coulomb":
            friction[term.place] += estimate.of(term)[0]
    return np.maximum(friction, 0.0)
