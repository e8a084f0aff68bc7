"""Controller and effects from recordings of commanded and measured positions: windows, search, fit, held-out stages."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import cached_property
from pathlib import Path

import numpy as np

from armlink.errors import BadInput
from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.model.load import SimModel
from sim_gap.position_gap.choice import (
    QUIET,
    About,
    Stage,
    groups_of,
    look_about,
    scale_left,
    select,
    stages,
    without_groups,
    worth,
)
from sim_gap.position_gap.fit import LoopFit, LoopSearch, rms_on
from sim_gap.position_gap.plant import MovedModel, nominal_point
from sim_gap.position_gap.sound_arm import FRICTION_SHARE, sound_gap
from sim_gap.position_gap.start import limited_servo_start, noise_floor, scales_of, starting_fit
from sim_gap.position_gap.training.bands import Band, band
from sim_gap.position_gap.training.export import Exported, export_fit, export_with_module, native_fit, widen_ranges
from sim_gap.position_gap.training.replay import nominal, replay_rms
from sim_gap.position_gap.training.spread import (
    Covariance,
    covariance,
    covariance_within,
    gaps_left_out,
    known_before,
    terms_of,
)
from sim_gap.position_gap.training.unreached_limits import find_unreached
from sim_gap.position_gap.windows import Windows, thin, windows_of
from sim_gap.residuals.residual_set import EXPLAINED, SLIGHT_NM

FITTED, JUDGED = 12, 24
"""Most windows of the fit, and of the judgement."""


@dataclass(frozen=True, eq=False)
class Identified:
    sim: SimModel
    search: LoopSearch
    fit: LoopFit
    heldout: Windows
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
    sound: bool
    """Whether a sound arm may have the nominal model's gap; not known if the controller had to be found."""
    moved_train: Array
    """RMS gap of the nominal model that runs free along the training commands [rad]; NaN if the controller had to be
    found, or none is commanded long enough."""
    moved_before: Array
    """The same along the held-out commands [rad]."""
    recordings: tuple[Recording, ...]
    """Held-out recordings."""
    gains: tuple[float, ...]
    """The controller's gains in each of them over those in the first training recording."""

    @cached_property
    def native(self) -> LoopFit:
        """The fit of what a simulator holds alone, made when somebody wants it."""
        return native_fit(self.search, self.fit)

    @cached_property
    def export(self) -> Exported | None:
        """The model to be used alone; None if the model did not come from a file."""
        if self.sim.path is None:
            return None
        return export_fit(self.sim, self.search, self.fit, self.native)

    @cached_property
    def beside(self) -> Exported | None:
        """The model to be used with a module; None if a module would have nothing to do."""
        return export_with_module(self.sim, self.search, self.fit) if self.sim.path is not None else None


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
    sim = widen_ranges(sim, [*train, *heldout])
    progress("reading the motion")
    plant = MovedModel(sim)
    complete = bool(plant.driven.all())
    data = thin(windows_of(plant, train, labels[: len(train)], scale[: len(train)]), FITTED, moving=True)
    judged = thin(windows_of(plant, heldout, labels[len(train) :], scale[len(train) :]), JUDGED)
    never = frozenset(withhold) | _frozen(sim, data)
    search = LoopSearch(data, scales_of(data), nominal_point(plant), noise_floor(data), never)
    moved_train = moved = np.full(sim.n, np.nan)
    if complete:
        moved_train, moved = (
            replay_rms(nominal(sim), some, gain)
            for some, gain in ((train, scale[: len(train)]), (heldout, scale[len(train) :]))
        )
    about = _fitted(search, complete, progress)
    search, fit = about.search, about.fit
    progress("testing each effect on held-out data")
    margin = _margin(search, fit)
    usual, sound = sound_gap(search, judged, margin) if complete else (np.zeros(sim.n), False)
    found = tuple(stages(about, judged, np.maximum(margin, 2.0 * usual)))
    before = _bare(search, fit, complete)
    terms = terms_of(search, fit)
    spread = replace(covariance(search, fit), limits=find_unreached(search, fit))
    left = gaps_left_out(data, terms, known_before(search, fit))
    return Identified(
        sim=sim,
        search=search,
        fit=fit,
        heldout=judged,
        stages=found,
        spread=spread,
        within=covariance_within(search, fit, terms),
        band=band(search, fit, spread, left, judged),
        train_before=rms_on(data, before.point),
        train_after=rms_on(data, fit.point),
        heldout_before=rms_on(judged, before.point),
        heldout_after=rms_on(judged, fit.point),
        margin=margin,
        sound=sound,
        moved_train=moved_train,
        moved_before=moved,
        recordings=tuple(heldout),
        gains=tuple(scale[len(train) :]),
    )


def _fitted(search: LoopSearch, complete: bool, progress: Callable[[str], None]) -> About:
    """The fit with the effects that it takes, and all that may be chosen about it; the nominal model as it is where it
    leaves nothing."""
    if complete and bool(np.all(rms_on(search.data, search.nominal) < QUIET * search.floor)):
        return look_about(search, LoopFit(search.nominal), [])
    search, fit = starting_fit(search, progress)
    best = select(search, fit, progress)
    left, gap = (scale_left(search, point) for point in (best.point, search.nominal))
    unexplained = left > np.maximum(EXPLAINED * gap, QUIET * search.floor)
    unexplained &= ~np.isin(np.arange(search.data.joints), sorted(search.resting))
    if complete and unexplained.any():
        progress("fitting servos with limits as a start")
        other = select(search, limited_servo_start(search, best, unexplained), progress)
        best = max(best, other, key=lambda each: worth(search, each))
    # all candidates: what the start has explained already may have rivals that were not looked at
    return look_about(search, best)


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
            raise BadInput(f"--gain {text}: there is no recording of this name: {', '.join(labels)}")
        found |= dict.fromkeys(hits, value)
    if missing := [label for i, label in enumerate(labels) if i not in found]:
        raise BadInput(f"--gain: no gain is given for {missing[0]}: give the gain of every recording")
    return [found[i] / found[0] for i in range(len(labels))]


def _bare(search: LoopSearch, fit: LoopFit, complete: bool) -> LoopFit:
    """The nominal model with its own controller, or with that of the fit, fitted again without any effect."""
    if complete:
        own = {name: values.copy() for name, values in search.nominal.items()}
        return LoopFit(own | {"creep": search.data.plant.creep})
    return search.improve(without_groups(search, fit, *groups_of(fit, search)), 4)


def _frozen(sim: SimModel, data: Windows) -> frozenset[str]:
    """Effects that nothing can show here: those that need gravity, and damping by a motor that is never switched off,
    which acts as viscous friction does."""
    weightless = np.linalg.norm(sim.arm.gravity) < 1e-6
    never = {"base.tilt", "position.offset"} if weightless else set[str]()
    return frozenset(never if bool((data.served < 0.5).any()) else never | {"actuator.back_emf"})


def _margin(search: LoopSearch, fit: LoopFit) -> Array:
    """RMS from which it is a gap, per joint (J,) [rad]: torque that matters, at most a share of the joint's, over the
    gain, at most that share of the tracking error."""
    torque = np.minimum(SLIGHT_NM, FRICTION_SHARE * search.scales.torque)
    matters = np.minimum(torque / fit.point["kp"], FRICTION_SHARE * search.scales.angle)
    return np.asarray(np.maximum(2.0 * search.floor, matters))
