"""Entry point of the diagnosis in Python: a nominal model and recordings in, a `Diagnosis` out.

In order: the model (`sim_gap.model`), prepared recordings and residuals (`sim_gap.residuals`), selection and fit of
effects (`sim_gap.search`), causes, and the answer with the verdict (this package). `armlink gap diagnose`
(`sim_gap.commands.gap_diagnose`) reads the files, calls `diagnose` and shows its result.
"""

from collections.abc import Sequence
from typing import Any

from armlink.errors import BadInput
from armlink.recording.recording import Recording, default_names, slice_rows
from sim_gap.attribution.answer import Internals, answer
from sim_gap.attribution.bodies import groups_of, placed
from sim_gap.attribution.causes import causes
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.attribution.rivals import Rivals
from sim_gap.attribution.verdict import is_quiet
from sim_gap.effects.registry import library_without
from sim_gap.model.load import load_model
from sim_gap.residuals.preprocess import prepare, require_length
from sim_gap.residuals.residual_set import ResidualSet, residual_sets
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.estimate import Estimate
from sim_gap.search.model_selection import select_model

OWN_HELDOUT = 0.3
"""Share at the end of each training recording that is held out if no held-out recording is given."""
OWN_HELDOUT_S = 3.0
"""Least length of it [s], up to half of a short recording."""


def diagnose(
    model: Any,
    train: Sequence[Recording],
    heldout: Sequence[Recording] = (),
    *,
    labels: Sequence[str] = (),
    withhold: Sequence[str] = (),
    groups: Sequence[str] = (),
) -> Diagnosis:
    """Explain the gap between a simulation model and recordings of the real arm.

    Args:
        model: path of an MJCF, URDF or arm file, or a compiled `mujoco.MjModel`; the nominal arm.
        train: recordings to fit.
        heldout: recordings to judge on, not used in the fit; without any, the end of each training recording is.
        labels: names of the recordings for messages, train first.
        groups: `NAME=REC[,REC…]`: recordings (by label) that share a body; without any, it is found which do.
        withhold: ids of effects to leave out of the library (blind check).

    Raises BadInput if the recordings cannot be used with the model.
    """
    if not train:
        raise BadInput("no training recording: give at least one (--train FILE)")
    sim = load_model(model, _names(train[0]), train[0].n)
    labels = list(labels) or [f"recording {i + 1}" for i in range(len(train) + len(heldout))]
    for recording, label in zip([*train, *heldout], labels, strict=False):
        require_length(recording, label)
    heldout_is = "the recordings given" if heldout else f"the last {OWN_HELDOUT:.0%} of each training recording"
    numbers = list(range(1, len(train) + len(heldout) + 1))
    named = groups_of(groups, labels)
    if not heldout:
        train, heldout, labels, numbers, named = *_split(train), labels * 2, numbers * 2, named * 2
    ready = [
        prepare(recording, sim.arm, label, number, names)
        for recording, label, number, names in zip([*train, *heldout], labels, numbers, named, strict=False)
    ]
    fit, judge = residual_sets(ready[: len(train)], ready[len(train) :])
    _require_motion(fit)
    store = ColumnStore(fit)
    search = select_model(store, library_without(withhold))
    estimate = Estimate(search.normal.store, search.active)
    judge = placed(estimate, judge)
    quiet = not fit.impacts and is_quiet(judge) and is_quiet(fit)
    found, minor = causes(estimate, judge, Rivals(search), sim.arm.names, quiet=quiet)
    if quiet and not found:
        return answer(Internals(sim, fit, judge, None, tuple(heldout), estimate), [], [], heldout_is)
    return answer(Internals(sim, fit, judge, estimate, tuple(heldout), estimate), found, minor, heldout_is)


def _names(recording: Recording) -> tuple[str, ...]:
    """Joint names given in the recording itself, if any."""
    return () if recording.names == default_names(recording.n) else tuple(recording.names)


def _split(recordings: Sequence[Recording]) -> tuple[list[Recording], list[Recording]]:
    """Each recording without its end, and the ends."""
    first, last = [], []
    for recording in recordings:
        span = recording.t[-1] - recording.t[0]
        cut = recording.t[-1] - max(OWN_HELDOUT * span, min(OWN_HELDOUT_S, 0.5 * span))
        first.append(slice_rows(recording, recording.t < cut))
        last.append(slice_rows(recording, recording.t >= cut))
    return first, last


def _require_motion(data: ResidualSet) -> None:
    """Raise BadInput if no joint moves."""
    if not any(s.moving.mean(0).max() > 0.02 for s in data.signals):
        raise BadInput(
            f"{data.signals[0].label}: no joint moves in the training recordings: they cannot tell what causes a gap; "
            "record every joint in motion"
        )
