"""Entry point of the diagnosis in Python: a nominal model and recordings in, a `Diagnosis` out.

In order: the model (`sim_gap.model`), the check of joints, units and clocks (`sim_gap.checks`), prepared recordings and
residuals (`sim_gap.residuals`), selection and fit of effects (`sim_gap.search`), causes, and the answer with verdict
(this package). Recordings without torque go another way after the check: `position_answer` explains their positions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from armlink.errors import BadInput
from armlink.recording.corrections import AS_IT_IS, Corrections
from armlink.recording.recording import Recording, default_names, slice_rows
from gcomp.arrays import Array
from sim_gap.attribution.bodies import (
    body_of,
    groups_of,
    mounts,
    numbered_by_body,
    recordings_with_another_body,
)
from sim_gap.attribution.causes import causes, remainder
from sim_gap.attribution.diagnosis import HINT, Cause, Diagnosis
from sim_gap.attribution.friction_compensation import find_compensations, held_in_commands
from sim_gap.attribution.notes import aside_notes, law_notes, notes, worse_notes
from sim_gap.attribution.position_answer import diagnose_positions
from sim_gap.attribution.residual_laws import as_effects, residual_laws
from sim_gap.attribution.rivals import Rivals
from sim_gap.attribution.rollout import roll_out
from sim_gap.attribution.verdict import is_within, share_left, verdict
from sim_gap.checks.check import (
    check_position_only,
    check_recordings,
    is_position_only,
    match_joints,
    times_in_motion,
    unchecked_note,
)
from sim_gap.checks.finding import RecordingFinding
from sim_gap.effects.registry import library_without
from sim_gap.model.load import KnownGains, SimModel, ends_of, joints_between, load_compiled, load_model, with_gains
from sim_gap.residuals.disregarded_rows import fast_gaps, share_left_out, slides, slow_gaps, without_disturbances
from sim_gap.residuals.preprocess import SHORTEST_PIECE_S, SHORTEST_S, prepare, require_length
from sim_gap.residuals.residual_set import ResidualSet, by_joint, locate, residual_sets, row_rms
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.model_selection import AGAIN, ROUNDS, select_model
from sim_gap.search.term_equations import TermChoice

OWN_HELDOUT = 0.3
"""Share at the end of each training recording that is held out if no held-out recording is given."""
LENT = "the first half was used for the fit, since no training recording has the same load at the tip"
"""Why half of a held-out recording is fitted."""


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


def diagnose(
    model: Any,
    train: Sequence[Recording],
    heldout: Sequence[Recording] = (),
    *,
    labels: Sequence[str] = (),
    withhold: Sequence[str] = (),
    stated: Corrections = AS_IT_IS,
    groups: Sequence[str] = (),
    gains: Sequence[str] = (),
    known_gains: KnownGains | None = None,
    base: str | None = None,
    tip: str | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> Diagnosis:
    """Explain the gap between a simulation model and recordings of the real arm, as `sim_gap.api.diagnose`.

    Args:
        labels: names of the recordings for messages, train first.
        groups: `NAME=REC[,REC…]`: recordings (by label) that share a body; without any, it is found which do.
        withhold: ids of effects to leave out of the library (blind check).
        stated: corrections that the user states, not made yet, with joints numbered from base to tip; the check looks
            into none of them again.
        gains: `RECORDING=VALUE`: gain of the position controller in recordings that differ in it; only without torque.
        known_gains: those of the position controllers, where the model lacks them; only without torque.
        progress: gets the stage that begins; used where no recording has a torque channel.

    Without a torque channel in any recording, `q_cmd` and `q` are explained instead (`positions`).

    Raises BadInput if the recordings cannot be used with the model.
    """
    if not train:
        raise BadInput("there is no training recording: give at least one (--train FILE)")
    labels = list(labels) or [f"recording {i + 1}" for i in range(len(train) + len(heldout))]
    sim, recordings, findings = checked_recordings(model, [*train, *heldout], labels, stated, base, tip, known_gains)
    train, heldout = recordings[: len(train)], recordings[len(train) :]
    heldout_is = "the recordings given" if heldout else f"the last {OWN_HELDOUT:.0%} of each training recording"
    numbers = list(range(1, len(train) + len(heldout) + 1))
    named, compensated = groups_of(groups, labels), held_in_commands(recordings, labels)
    starts = [float(recording.t[0]) for recording in recordings]
    if not heldout:
        train, heldout, labels, numbers, named, starts = *_split(train), labels * 2, numbers * 2, named * 2, starts * 2
    if all(is_position_only(recording) for recording in [*train, *heldout]):
        made = diagnose_positions(
            sim, train, heldout, labels, withhold=withhold, heldout_is=heldout_is, gains=gains, progress=progress
        )
        return replace(made, checks=findings, notes=(*made.notes, *_units_note(sim)))
    ready = [
        prepare(recording, sim.arm, label, number, names, start)
        for recording, label, number, names, start in zip(
            [*train, *heldout], labels, numbers, named, starts, strict=False
        )
    ]
    fit, judge = residual_sets(ready[: len(train)], ready[len(train) :])
    _require_motion(fit)
    library = library_without(withhold)
    search, estimate = _fitted(fit, library)
    judge = _placed(estimate, judge)
    if "link.payload" in library and (lent := recordings_with_another_body(estimate, judge)):
        more, rest, recordings = _lent(fit, judge, heldout, lent)
        other, again = _fitted(more, library)
        if body_of(again) is not None:
            search, estimate, judge, heldout = other, again, _placed(again, rest), recordings
            heldout_is += (
                f"; of {', '.join(judge.signals[k].label for k in lent)} only the second half is held out: {LENT}"
            )
    fit = estimate.store.data
    within = not fit.impacts and is_within(judge) and is_within(fit)
    found, minor = causes(estimate, judge, Rivals(search), sim.arm.names, within=within)
    shown, minor = (estimate, minor) if found or not within else (EffectEstimate(estimate.store, ()), [])
    made = _answer(Internals(sim, fit, judge, shown, tuple(heldout), estimate), found, minor, heldout_is)
    compensated += find_compensations(estimate, (fit, judge))
    told = tuple(each.sentence() for each in compensated)
    aside = (*told, *unchecked_note(recordings), *_units_note(sim))
    made = replace(made, checks=findings, notes=(*made.notes, *aside), friction_compensation=tuple(compensated))
    settled = not made.doubts or made.verdict == "unexplained"
    return made if settled else replace(made, verdict="ambiguous")


def _units_note(sim: SimModel) -> tuple[str, ...]:
    slides = ", ".join(name for name, slides in zip(sim.arm.names, sim.arm.slides, strict=True) if slides)
    return (f"{slides}: of prismatic joints the gap is in N or m, not in N·m or rad",) if slides else ()


def _answer(made: Internals, found: list[Cause], minor: list[Cause], heldout_is: str) -> Diagnosis:
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


def _placed(estimate: EffectEstimate, heldout: ResidualSet) -> ResidualSet:
    """The held-out recordings by the body that they have (`numbered_by_body`), without what disturbed the arm."""
    judge = numbered_by_body(estimate, heldout)
    return without_disturbances(judge, estimate.predict(judge))


def _fitted(fit: ResidualSet, library: Sequence[str]) -> tuple[TermChoice, EffectEstimate]:
    """The search of the library and the fit (`_searched`); again without what disturbed the arm, if anything did."""
    search, estimate = _searched(fit, library)
    data = estimate.store.data
    undisturbed = without_disturbances(data, estimate.predict(data))
    return (search, estimate) if undisturbed is data else _searched(undisturbed, library)


def _searched(fit: ResidualSet, library: Sequence[str]) -> tuple[TermChoice, EffectEstimate]:
    """The search of the library and the fit; again if a body is mounted in different ways, kept if that is better."""
    search = select_model(ColumnStore(fit), library)
    estimate = EffectEstimate(search.equations.store, search.current)
    for _ in range(ROUNDS):
        signals = estimate.store.data.signals
        angles = mounts(estimate)
        if angles == tuple(s.mount for s in signals):
            break
        turned = tuple(replace(s, mount=angle) for s, angle in zip(signals, angles, strict=True))
        again = select_model(ColumnStore(ResidualSet(turned, fit.layout)), library)
        if again.score > search.score - AGAIN * search.equations.measurements:
            break
        search, estimate = again, EffectEstimate(again.equations.store, again.current)
    return search, estimate


def _lent(
    fit: ResidualSet, judge: ResidualSet, heldout: Sequence[Recording], lent: Sequence[int]
) -> tuple[ResidualSet, ResidualSet, list[Recording]]:
    """Training and held-out sets with the first half of some held-out recordings in the training set, and what remains
    of the held-out recordings."""
    train, rest, recordings = list(fit.signals), list(judge.signals), list(heldout)
    for number, k in enumerate(lent, start=max(s.number for s in train) + 1):
        s, whole = judge.signals[k], heldout[k]
        middle = 0.5 * float(whole.t[0] + whole.t[-1])
        start = float(whole.t[0]) - float(s.t[0])
        parts = [slice_rows(whole, whole.t < middle), slice_rows(whole, whole.t >= middle)]
        first, second = (prepare(part, s.arm, s.label, number, s.groups, start) for part in parts)
        train.append(first)
        rest[k], recordings[k] = second, parts[1]
    return *residual_sets(train, rest), recordings


def checked_recordings(
    source: Any,
    recordings: Sequence[Recording],
    labels: Sequence[str],
    stated: Corrections,
    base: str | None,
    tip: str | None,
    known_gains: KnownGains | None = None,
) -> tuple[SimModel, list[Recording], tuple[RecordingFinding, ...]]:
    """The model with the gains that are known, the recordings with joints, units and clocks as they should be, and what
    was found in them. Raises BadInput, for gains where the recordings have a torque channel too."""
    compiled_model = load_compiled(source)
    own_base, own_tip = ends_of(source)
    joints = joints_between(compiled_model, base or own_base, tip or own_tip)
    matched, findings = [], []
    for recording, label in zip(recordings, labels, strict=False):
        taken, found = match_joints(recording, list(joints), stated, label)
        matched.append(stated.apply(taken, label).check(label))
        findings += [finding for finding in found if finding not in findings]
    names = () if matched[0].names == default_names(matched[0].n) else matched[0].names
    path = Path(source) if isinstance(source, str | Path) else None
    sim = load_model(compiled_model, names, matched[0].n, joints, path)
    alone = all(is_position_only(recording) for recording in matched)
    require_length(matched, labels, 0.0 if alone else SHORTEST_PIECE_S)
    if alone:
        checked, found = check_position_only(sim.arm, matched, labels[: len(matched)], stated)
        sim = sim if known_gains is None else with_gains(sim, known_gains)
    elif known_gains is not None:
        raise BadInput(
            "--gains: leave this option out, since the recordings have a torque channel, which is compared with "
            "the model's torque"
        )
    else:
        checked, found = check_recordings(sim.arm, matched, labels[: len(matched)], stated)
    return sim, checked, (*findings, *found)


def _split(recordings: Sequence[Recording]) -> tuple[list[Recording], list[Recording]]:
    """Each recording without its end, and the ends: what is fitted and what judges both hold motion, if the arm comes
    to rest before its end as one does that swings free."""
    first, last = [], []
    for recording in recordings:
        span = recording.t[-1] - recording.t[0]
        cut = recording.t[-1] - max(OWN_HELDOUT * span, min(SHORTEST_S, 0.5 * span))
        moved = times_in_motion(recording)
        if len(moved):
            cut = min(cut, max(float(np.quantile(moved, 1.0 - OWN_HELDOUT)), recording.t[0] + SHORTEST_PIECE_S))
        first.append(slice_rows(recording, recording.t < cut))
        last.append(slice_rows(recording, recording.t >= cut))
    return first, last


def _require_motion(data: ResidualSet) -> None:
    if not any(s.moving.mean(0).max() > 0.02 for s in data.signals):
        raise BadInput(
            f"{data.signals[0].label}: no joint moves in the training recordings, so the cause of a gap "
            "cannot be found: record every joint in motion"
        )
