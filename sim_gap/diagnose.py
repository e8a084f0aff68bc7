"""The diagnosis: recordings and a model in, where, which effect and how far out."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armlink.errors import BadInput
from armlink.recording import Recording, slice_rows
from sim_gap.causes import causes, left_over
from sim_gap.confound import Rivals
from sim_gap.diagnosis import Cause, Diagnosis, Verdict
from sim_gap.effects.registry import effects, layout_of
from sim_gap.estimate import Estimate
from sim_gap.model import SimModel, load_model
from sim_gap.normal import ColumnStore, Normal
from sim_gap.regime import by_joint, floor_by_joint, places
from sim_gap.residual import ResidualSet
from sim_gap.rigid import Array
from sim_gap.select import Search, candidates, refine
from sim_gap.signals import Signals, prepare

OWN_HELDOUT = 0.3
"""Share at the end of each training recording that is kept for judging where no other motion is given."""
CARE = 0.01
"""A gap that a user would care about, as a share of the joint's largest torque in the recording."""
EXPLAINED = 0.15
"""Share of the gap (in squares, above the noise) that may be left in an explained diagnosis."""


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
    told = "the recordings given" if heldout else f"the last {OWN_HELDOUT:.0%} of each training recording"
    if not heldout:
        train, heldout, labels = *_split(train), labels * 2
    ready = [prepare(r, sim.arm, label) for r, label in zip([*train, *heldout], labels, strict=False)]
    layout = layout_of(ready)
    fit, judge = (ResidualSet(tuple(part), layout) for part in (ready[: len(train)], ready[len(train) :]))
    margin = 2.0 * floor_by_joint(judge) + CARE * _largest_torque(ready)
    notes = _notes(fit)
    _refuse_rest(fit)
    before, before_train = by_joint(judge), by_joint(fit)
    if np.all(np.maximum(before, before_train) <= margin):
        nothing = Internals(sim, fit, judge, None)
        same = before_train, before_train, before, before, 0.0
        return Diagnosis(
            "no_gap",
            sim.arm.names,
            tuple(places(judge)),
            (),
            floor_by_joint(judge),
            *same,
            margin,
            told,
            None,
            notes,
            nothing,
        )
    store = ColumnStore(fit)
    search = Search(Normal(store, candidates(layout, [name for name in effects() if name not in withhold])))
    estimate = Estimate(store, refine(store, search.run()))
    found = causes(estimate, judge, Rivals(search), sim.arm.names)
    after = by_joint(judge, left_over(judge, estimate.predict(judge)))
    after_train = by_joint(fit, left_over(fit, estimate.predict(fit)))
    floor = floor_by_joint(judge)
    unexplained = _share_left(before, after, floor)
    return Diagnosis(
        _verdict(found, unexplained, after, margin),
        sim.arm.names,
        tuple(places(judge)),
        tuple(found),
        floor,
        before_train,
        after_train,
        before,
        after,
        unexplained,
        margin,
        told,
        None,
        notes,
        Internals(sim, fit, judge, estimate),
    )


def _names(recording: Recording) -> tuple[str, ...]:
    return tuple(recording.names)


def _split(recordings: Sequence[Recording]) -> tuple[list[Recording], list[Recording]]:
    first, last = [], []
    for recording in recordings:
        cut = recording.t[0] + (1.0 - OWN_HELDOUT) * (recording.t[-1] - recording.t[0])
        first.append(slice_rows(recording, recording.t < cut))
        last.append(slice_rows(recording, recording.t >= cut))
    return first, last


def _largest_torque(ready: Sequence[Signals]) -> Array:
    return np.asarray(np.max([np.abs(s.model).max(0) for s in ready], axis=0))


def _notes(data: ResidualSet) -> tuple[str, ...]:
    still = [
        f"{data.signals[0].arm.names[joint]} hardly moves: its {channel} tells nothing of friction here"
        for channel, joint in data.rows
        if channel == data.layout.motor and data.valid[channel, joint].sum() <= 25
    ]
    return tuple(still)


def _refuse_rest(data: ResidualSet) -> None:
    """Raise BadInput where no joint moves: such a recording cannot tell anything."""
    if not any(s.moving.mean(0).max() > 0.02 for s in data.signals):
        raise BadInput(
            f"{data.signals[0].label}: no joint moves in the training recordings: this recording cannot tell what causes a gap; "
            "record every joint in motion"
        )


def _share_left(before: Array, after: Array, floor: Array) -> float:
    """Share of the squared gap above the noise that is left, each joint relative to its own gap before, worst joints count most."""
    excess_before = np.maximum(before**2 - floor**2, 0.0)
    excess_after = np.maximum(after**2 - floor**2, 0.0)
    weight = 1.0 / np.maximum(before**2, 1e-12) * (before > 2.0 * floor)
    total = float((weight * excess_before).sum())
    return float((weight * excess_after).sum()) / total if total > 0 else 0.0


def _verdict(found: Sequence[Cause], unexplained: float, after: Array, margin: Array) -> Verdict:
    if not found or (unexplained > EXPLAINED and np.any(after > margin)):
        return "unexplained"
    return "ambiguous" if found[0].confounded_with else "explained"
