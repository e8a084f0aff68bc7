"""The diagnosis: recordings and a model in, where, which effect and how far out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from armlink.errors import BadInput
from armlink.recording.recording import Recording, default_names, slice_rows
from sim_gap.attribution.causes import causes, left_over
from sim_gap.attribution.confidence import HINT
from sim_gap.attribution.diagnosis import Cause, Diagnosis
from sim_gap.attribution.notes import notes
from sim_gap.attribution.rivals import Rivals
from sim_gap.attribution.rollout import roll_out
from sim_gap.attribution.verdict import is_quiet, share_left, verdict
from sim_gap.effects.registry import layout_of, library_without
from sim_gap.model.load import SimModel, load_model
from sim_gap.residuals.preprocess import prepare, require_length
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.residuals.stuck_channels import Stuck, without_stuck
from sim_gap.residuals.where import by_joint, combined, places
from sim_gap.search.estimate import Estimate
from sim_gap.search.model_selection import compete
from sim_gap.search.normal_equations import ColumnStore

OWN_HELDOUT = 0.3
"""Share at the end of each training recording that is kept for judging where no other motion is given."""
OWN_HELDOUT_S = 3.0
"""It is at least so long [s], or half of a short recording."""


@dataclass(frozen=True, eq=False)
class Internals:
    """What the answer was made from, for report, roll-out and export."""

    model: SimModel
    train: ResidualSet
    heldout: ResidualSet
    estimate: Estimate | None


def diagnose(
    model: Any,
    train: Sequence[Recording],
    heldout: Sequence[Recording] = (),
    *,
    labels: Sequence[str] = (),
    withhold: Sequence[str] = (),
) -> Diagnosis:
    """Explain the gap between a simulation model and recordings of the real arm.

    Args:
        model: path of an MJCF, URDF or arm file, or a compiled `mujoco.MjModel`; the nominal arm.
        train: recordings to fit.
        heldout: recordings of other motion to judge on; without any, the end of each training recording is kept back.
        labels: names of the recordings for messages, train first.
        withhold: ids of effects to leave out of the library (blind check).

    Raises BadInput where the recordings cannot be used with the model.
    """
    if not train:
        raise BadInput("no training recording: give at least one (--train FILE)")
    sim = load_model(model, _names(train[0]), train[0].n)
    labels = list(labels) or [f"recording {i + 1}" for i in range(len(train) + len(heldout))]
    for recording, label in zip([*train, *heldout], labels, strict=False):
        require_length(recording, label)
    told = "the recordings given" if heldout else f"the last {OWN_HELDOUT:.0%} of each training recording"
    numbers = [*range(1, len(train) + 1), *([0] * len(heldout))]
    if not heldout:
        train, heldout, labels, numbers = *_split(train), labels * 2, numbers * 2
    ready = [
        replace(prepare(r, sim.arm, label), number=number)
        for r, label, number in zip([*train, *heldout], labels, numbers, strict=False)
    ]
    checked = [without_stuck(s, r) for s, r in zip(ready, [*train, *heldout], strict=True)]
    ready = [s for s, _ in checked]
    stuck = tuple(one for _, found in checked for one in found)
    layout = layout_of(ready)
    fit, judge = (ResidualSet(tuple(part), layout) for part in (ready[: len(train)], ready[len(train) :]))
    _refuse_rest(fit)
    store = ColumnStore(fit)
    search = compete(store, library_without(withhold))
    estimate = Estimate(store, search.active)
    quiet = not fit.struck and is_quiet(judge) and is_quiet(fit)
    found, minor = causes(estimate, judge, Rivals(search), sim.arm.names, quiet=quiet)
    if quiet and not found:
        return _answer(Internals(sim, fit, judge, None), [], [], told, stuck)
    return _answer(Internals(sim, fit, judge, estimate), found, minor, told, stuck)


def _answer(made: Internals, found: list[Cause], minor: list[Cause], told: str, stuck: Sequence[Stuck]) -> Diagnosis:
    fit, judge, estimate = made.train, made.heldout, made.estimate
    left, left_fit = (
        left_over(data, estimate.predict(data)) if estimate is not None else data.values for data in (judge, fit)
    )
    told_verdict = "no_gap" if estimate is None else verdict(found, judge, left)
    if stuck or (fit.struck and not any(cause.effect == "transmission.backlash" for cause in found)):
        told_verdict = "unexplained"
    return Diagnosis(
        verdict=told_verdict,
        names=made.model.arm.names,
        where=tuple(places(judge)),
        causes=tuple(_hints(found) if told_verdict == "unexplained" else found),
        minor=tuple(minor),
        noise_floor=combined(judge, judge.floor),
        train_before=by_joint(fit),
        train_after=by_joint(fit, left_fit),
        heldout_before=by_joint(judge),
        heldout_after=by_joint(judge, left),
        unexplained=share_left(judge, left),
        margin=combined(judge, judge.margin),
        heldout_is=told,
        rollout=roll_out(made.model, judge, estimate),
        notes=notes(found, stuck, estimate, fit, judge, left),
        internals=made,
    )


def _hints(found: list[Cause]) -> list[Cause]:
    """Causes as they stand where structure is left that nothing explains: none is blamed."""
    return [replace(cause, confidence=min(cause.confidence, HINT)) for cause in found]


def _names(recording: Recording) -> tuple[str, ...]:
    """Joint names that the recording itself gives, if any."""
    return () if recording.names == default_names(recording.n) else tuple(recording.names)


def _split(recordings: Sequence[Recording]) -> tuple[list[Recording], list[Recording]]:
    first, last = [], []
    for recording in recordings:
        span = recording.t[-1] - recording.t[0]
        cut = recording.t[-1] - max(OWN_HELDOUT * span, min(OWN_HELDOUT_S, 0.5 * span))
        first.append(slice_rows(recording, recording.t < cut))
        last.append(slice_rows(recording, recording.t >= cut))
    return first, last


def _refuse_rest(data: ResidualSet) -> None:
    """Raise BadInput where no joint moves: such a recording cannot tell anything."""
    if not any(s.moving.mean(0).max() > 0.02 for s in data.signals):
        raise BadInput(
            f"{data.signals[0].label}: no joint moves in the training recordings: this recording cannot tell what "
            "causes a gap; record every joint in motion"
        )
