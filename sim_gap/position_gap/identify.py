"""Controller and effects from recordings of commanded and measured positions: windows, search, fit, held-out stages."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from armlink.errors import BadInput
from armlink.recording.recording import Recording
from gcomp.arrays import Array, Mask
from sim_gap.model.load import SimModel
from sim_gap.position_gap.columns import shared_effects, with_columns
from sim_gap.position_gap.controller import nominal_controller, nominal_point, scales_of, starting_fit
from sim_gap.position_gap.doubt import settle
from sim_gap.position_gap.fit import LoopFit, evaluate, improve
from sim_gap.position_gap.judge import Stage, groups_of, rms_on, stages
from sim_gap.position_gap.nominal_motion import OwnMotion, full_score, nominal_solver, other_solver, own_motion, solvers
from sim_gap.position_gap.search import (
    LoopSearch,
    balance,
    effects_at,
    merge_joint,
    weigh_kinds,
    without_effect,
    without_group,
)
from sim_gap.position_gap.selection import select_about
from sim_gap.position_gap.sound_arm import SoundGap, split_gap
from sim_gap.position_gap.surface import Surface, find_surface, rows_of_touch
from sim_gap.position_gap.training.bands import Band, band
from sim_gap.position_gap.training.export import Exported, export_fit, export_with_module, native_fit, widen_ranges
from sim_gap.position_gap.training.jackknife import leave_out
from sim_gap.position_gap.training.replay import Simulated, replay_rms
from sim_gap.position_gap.training.spread import Covariance, alternatives, covariance, covariance_within, vague_limits
from sim_gap.position_gap.training.unreached_limits import find_unreached
from sim_gap.position_gap.windows import Windows, thin, thin_moving, windows_of

SEARCHED, FITTED, JUDGED = 16, 32, 48
"""Most windows of the search, of the final fit and of the judgement."""
LEAST_FLOOR = 1e-5
"""Least noise floor of a position gap [rad]."""
TORQUE_MARGIN, SHARE_MARGIN = 0.08, 0.15
"""Torque that matters [N·m], at most this share of a joint's torque; over the gain it is a gap of position, at most
this share of the tracking error."""


@dataclass(frozen=True, eq=False)
class Identified:
    sim: SimModel
    search: LoopSearch
    fit: LoopFit
    heldout: Windows
    controller: str
    nominal_has_controller: bool
    stages: tuple[Stage, ...]
    spread: Covariance
    """Covariance of the parameters within recordings and from one to the next."""
    within: Covariance
    """Covariance within recordings alone: by it an effect is told from none."""
    band: Band
    train_before: Array
    train_after: Array
    heldout_before: Array
    heldout_after: Array
    margin: Array
    sound: SoundGap | None
    """The nominal model's gap beside what small errors make of it; None if the controller had to be found."""
    own: OwnMotion | None
    """The motion that the nominal model makes along the training commands; None if the controller had to be found."""
    moved_before: Array
    """RMS gap of the nominal model that MuJoCo moves along the held-out commands [rad]; NaN if the controller had to be
    found, or none is commanded long enough."""
    native: LoopFit
    export: Exported | None
    """The model to be used alone; None if the model did not come from a file."""
    beside: Exported | None
    """The model to be used with a module; None if a module would have nothing to do."""
    recordings: tuple[Recording, ...]
    """Held-out recordings."""
    gains: tuple[float, ...]
    """The controller's gains in each of them over those in the first training recording."""
    surface: Surface | None
    """Surface that the arm presses on in some recordings; those moments are not in the windows."""
    touched: tuple[Mask, ...]
    """Rows of each recording at which it does, train first."""

    @property
    def heldout_touched(self) -> tuple[Mask, ...]:
        """Rows of each held-out recording at which the arm presses on something."""
        return self.touched[-len(self.recordings) :]


def identify(
    sim: SimModel,
    train: Sequence[Recording],
    heldout: Sequence[Recording],
    labels: Sequence[str],
    withhold: Sequence[str],
    progress: Callable[[str], None],
    gains: Sequence[str] = (),
) -> Identified:
    """Fit controller and effects to `train` and judge them on `heldout`; `labels` name both, train first.

    `gains` are `RECORDING=VALUE`, the controller's gain in recordings that differ in it. Raises BadInput.
    """
    scale = gain_scales(gains, labels)
    recordings = [*train, *heldout]
    sim = widen_ranges(sim, recordings)
    progress("reading motion and model torques")
    surface = find_surface(sim.arm, recordings)
    whole = windows_of(sim.arm, train, labels[: len(train)], scales=scale[: len(train)], surface=surface)
    fitted = with_columns(thin_moving(whole, FITTED))
    other = windows_of(sim.arm, heldout, labels[len(train) :], fitted.dt, scale[len(train) :], surface)
    judged = with_columns(thin(other, JUDGED))
    own = nominal_controller(sim)
    data = thin_moving(fitted, SEARCHED)
    nominal = nominal_point(fitted, own)
    scales, floor = scales_of(fitted), noise_floor(fitted)
    never = frozenset(withhold) | _frozen(sim, fitted)
    search = LoopSearch(balance(data), scales, nominal, floor, never)
    kinds = solvers(sim, search) if own.complete else []
    apart = tuple(rows_of_touch(surface, sim.arm, recording) for recording in recordings)
    itself, moved = None, np.full(sim.n, np.nan)
    if own.complete:
        search = nominal_solver(search, kinds)
        itself = own_motion(sim, train, scale[: len(train)], apart[: len(train)])
        search = replace(search, floor=itself.floor(search, kinds))
        model = Simulated(sim.mujoco_model, tuple(sim.joints))
        moved = replay_rms(model, heldout, scale[len(train) :], apart=apart[len(train) :])
    search, start, kind = starting_fit(search, own, progress)
    search = replace(search, data=weigh_kinds(search, data, start))
    fit = select_about(search, replace(start, rms=None), progress)
    if kinds and (solver := other_solver(search, fit, kinds)):
        progress("with another solver")
        there = replace(search, nominal={**search.nominal, **solver})
        again = select_about(there, replace(start.with_values(**solver), rms=None), progress)
        search, fit = (there, again) if full_score(there, again) < full_score(search, fit) else (search, fit)
    progress("final fit")
    search = replace(search, data=weigh_kinds(search, fitted, fit))
    fit = improve(search.data, replace(fit, rms=None), scales, 6)
    fit, others = settle(search, fit, progress)
    if itself is not None:
        fit = not_worse(search, fit, itself.gaps.max(0))
    progress("each effect on held-out data")
    margin = _margin(search, fit)
    split = split_gap(search, judged, margin) if own.complete else None
    matters = margin if split is None else np.maximum(margin, 2.0 * split.usual)
    few = weigh_kinds(search, data, fit)
    found = tuple(stages(replace(search, data=few), evaluate(few, fit), judged, matters))
    before = _bare(search, fit, own.complete)
    native = native_fit(search, fit)
    spread = replace(covariance(search, fit), others=alternatives(others))
    spread = replace(spread, limits=find_unreached(search, fit, vague_limits(spread)))
    return Identified(
        sim=sim,
        search=search,
        fit=fit,
        heldout=judged,
        controller=kind,
        nominal_has_controller=own.complete,
        stages=found,
        spread=spread,
        within=covariance_within(search, fit),
        band=band(replace(search, data=fitted), fit, spread, leave_out(search, fit), judged),
        train_before=rms_on(fitted, before),
        train_after=rms_on(fitted, fit),
        heldout_before=rms_on(judged, before),
        heldout_after=rms_on(judged, fit),
        margin=margin,
        sound=split,
        own=itself,
        moved_before=moved,
        native=native,
        export=export_fit(sim, search, fit, native) if sim.path is not None else None,
        beside=export_with_module(sim, search, fit) if sim.path is not None else None,
        recordings=tuple(heldout),
        gains=tuple(scale[len(train) :]),
        surface=surface,
        touched=apart,
    )


def gain_scales(gains: Sequence[str], labels: Sequence[str]) -> list[float]:
    """Each recording's gain over that of the first, from `RECORDING=VALUE` with names or patterns such as *kp100*.

    Raises BadInput for a text that is none, a pattern without a recording, or a recording without a gain.
    """
    if not gains:
        return [1.0] * len(labels)
    found: dict[int, float] = {}
    for text in gains:
        pattern, _, number = text.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = 0.0
        if not pattern or not np.isfinite(value) or value <= 0.0:
            raise BadInput(f"--gain {text}: expected RECORDING=VALUE with a value above 0, such as *kp100*=100")
        hits = [i for i, label in enumerate(labels) if fnmatch(label, pattern) or fnmatch(Path(label).name, pattern)]
        if not hits:
            raise BadInput(f"--gain {text}: no recording of that name: {', '.join(labels)}")
        found |= dict.fromkeys(hits, value)
    if missing := [label for i, label in enumerate(labels) if i not in found]:
        raise BadInput(f"--gain: none given for {missing[0]}: state the gain of every recording")
    return [found[i] / found[0] for i in range(len(labels))]


def _bare(search: LoopSearch, fit: LoopFit, complete: bool) -> LoopFit:
    """The nominal model with its own controller, or with that of the fit, fitted again without any effect."""
    if complete:
        return LoopFit({name: values.copy() for name, values in search.nominal.items()}, ((),) * search.data.joints)
    for group in groups_of(fit, search):
        fit = without_group(search, fit, group)
    return improve(search.data, replace(fit, rms=None), search.scales, 6)


def _frozen(sim: SimModel, data: Windows) -> frozenset[str]:
    """Effects that nothing can show here: those that need gravity, and damping by a motor that is never switched off,
    which acts as viscous friction does."""
    weightless = np.linalg.norm(sim.arm.gravity) < 1e-6
    never = {"base.tilt", "position.offset"} if weightless else set[str]()
    return frozenset(never if bool((data.served < 0.5).any()) else never | {"actuator.back_emf"})


def not_worse(search: LoopSearch, fit: LoopFit, gap: Array) -> LoopFit:
    """The fit with the nominal model's own values at each joint at which they leave less of the training motion, or no
    more than twice the noise floor, or whose `gap` of the model that MuJoCo moves is no more (J,) [rad]."""
    bare = fit
    for j in range(search.data.joints):
        for effect in effects_at(fit, j):
            bare = without_effect(search, bare, effect, j)
    left = rms_on(search.data, bare)
    needless = (rms_on(search.data, fit) > left) | (np.minimum(left, gap) < 2.0 * search.floor)
    for j in np.flatnonzero(needless).tolist():
        fit = merge_joint(fit, bare, j)
    return evaluate(search.data, fit) if needless.any() else fit


def noise_floor(data: Windows) -> Array:
    """Standard deviation of the position readings about their smooth course, per joint (J,) [rad]."""
    first = data.warm
    smooth = data.recorded[first :: data.stride][: len(data.measured)]
    rest = (data.measured[: len(smooth)] - smooth) * data.weight[: len(smooth)]
    return np.asarray(np.maximum(np.sqrt(np.mean(rest**2, axis=(0, 2))), LEAST_FLOOR))


def _margin(search: LoopSearch, fit: LoopFit) -> Array:
    """RMS from which it is a gap, per joint (J,) [rad]."""
    torque = np.minimum(TORQUE_MARGIN, SHARE_MARGIN * search.scales.torque)
    matters = np.minimum(torque / fit.point["kp"], SHARE_MARGIN * search.scales.angle)
    return np.asarray(np.maximum(2.0 * search.floor, matters))


def columns_of_effect(found: Identified, effect: str) -> tuple[str, ...]:
    """Names of the fitted columns of an effect of the whole arm."""
    return tuple(n for n in shared_effects(found.sim.arm)[effect] if n in found.fit.shared)
