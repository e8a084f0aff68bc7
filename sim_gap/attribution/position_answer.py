"""The answer from recordings without a torque channel: causes, verdict, roll-out in radians, and notes."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from armlink.recording.recording import Recording
from gcomp.arrays import Array
from gcomp.estimate.linear_terms import PRICE
from sim_gap.attribution.diagnosis import HINT, Cause, Diagnosis, EffectRollout, Rollout, Signs, Verdict
from sim_gap.attribution.verdict import NEAR
from sim_gap.model.load import SimModel
from sim_gap.position_gap.choice import LEAST_SHRINK, Stage, groups_of
from sim_gap.position_gap.identify import Identified, identify
from sim_gap.position_gap.parameters import EFFECTS
from sim_gap.position_gap.plant import held_parts
from sim_gap.position_gap.start import controller_name
from sim_gap.position_gap.training.bands import SHARE
from sim_gap.position_gap.training.export import WRITTEN, effects_left_out, widened_joints
from sim_gap.position_gap.training.replay import (
    EACH_S,
    LONGEST_S,
    SHORT_S,
    Simulated,
    model_without,
    replay_rms,
    simulated_model,
)
from sim_gap.position_gap.training.spread import interval, payload_centre, undecided_scale
from sim_gap.position_gap.training.unreached_limits import describe
from sim_gap.residuals.residual_set import EXPLAINED, Location
from sim_gap.search.estimate import Value

ALMOST = 0.75
"""Highest confidence that positions alone give, below the 0.8 from which a cause is no hint: the sealed cases that
calibrate confidence all have torques."""
SEPARATE = {
    "controller.stiffness": "hold a known load with the joint, or record the motor's current",
    "controller.dead_zone": "measure the play by hand with the servo holding, or read the motor's encoder",
    "controller.delay": "command steps and a chirp up to 10 Hz",
}
OTHERWISE = "record slow and fast motion of this joint in both directions, with and without a known load"


def diagnose_positions(
    sim: SimModel,
    train: Sequence[Recording],
    heldout: Sequence[Recording],
    labels: Sequence[str],
    *,
    withhold: Sequence[str],
    heldout_is: str,
    progress: Callable[[str], None],
    gains: Sequence[str],
) -> Diagnosis:
    """Explain the gap between commanded and measured positions; arguments as of `diagnose.diagnose`."""
    found = identify(sim, train, heldout, labels, withhold, progress, gains)
    progress("replaying the corrected model")
    share = _left(found)
    taken, minor = [], list[Cause]()
    for stage in found.stages:
        changed, as_before = _apart(found, stage)
        if changed is not None and stage.worth > PRICE and _lowers(found, stage):
            taken.append((_cause(found, changed, share), stage))
            minor += [] if as_before is None else [_cause(found, as_before, share)]
        else:
            minor.append(_cause(found, stage, share))
    causes = [c for c, _ in taken]
    verdict = _verdict(found, causes, share)
    if verdict == "no_gap":
        taken, causes, minor = [], [], [*causes, *minor]
    rollout = _rollout(found, taken)
    if verdict != "no_gap" and rollout is not None and rollout.worse:
        verdict = "unexplained"
    if verdict == "unexplained":
        causes = [replace(cause, confidence=min(cause.confidence, HINT)) for cause in causes]
    return Diagnosis(
        verdict=verdict,
        names=sim.arm.names,
        where=_where(found),
        causes=tuple(causes),
        minor=tuple(minor),
        noise_floor=found.search.floor,
        train_before=found.train_before,
        train_after=found.train_after,
        heldout_before=found.heldout_before,
        heldout_after=found.heldout_after,
        unexplained=share,
        margin=found.margin,
        heldout_is=heldout_is,
        rollout=rollout,
        notes=(*notes(found), *running_free(found, rollout, gap=verdict != "no_gap")),
        band=found.band,
        unit="rad",
        internals=found,
    )


def _left(found: Identified) -> float:
    """Share of the squared gap beyond the noise that remains on held-out data."""
    floor = found.search.floor**2
    left = np.maximum(found.heldout_after**2 - floor, 0.0).sum()
    return float(left / max(float(np.maximum(found.heldout_before**2 - floor, 0.0).sum()), 1e-18))


def _lowers(found: Identified, stage: Stage) -> bool:
    """Whether it lowers the gap of a joint that has one."""
    gap = np.maximum(stage.before, found.heldout_before)
    return bool(((stage.share > LEAST_SHRINK) & (gap > found.margin)).any())


def _apart(found: Identified, stage: Stage) -> tuple[Stage | None, Stage | None]:
    """The stage at the joints where some parameter's interval leaves out the nominal value, and at the others."""
    effect, joints = stage.group

    def differs(at: tuple[int, ...]) -> bool:
        for j, name in found.search.places_of((effect, at)):
            own = interval(found.search, found.fit, found.within, j, name)
            if not own.low <= (float(found.search.nominal[name][j]) if j >= 0 else 0.0) <= own.high:
                return True
        return False

    if not joints:
        return (stage, None) if differs(()) else (None, stage)
    changed = tuple(j for j in joints if differs((j,)))
    others = tuple(j for j in joints if j not in changed)
    first, second = (replace(stage, group=(effect, each)) if each else None for each in (changed, others))
    return first, second


def _verdict(found: Identified, causes: Sequence[Cause], share: float) -> Verdict:
    if _is_within(found) or (not causes and _is_small(found)):
        return "no_gap"
    if not bool(np.all(found.train_after < np.maximum(NEAR * found.margin, EXPLAINED * found.train_before))):
        return "unexplained"
    near = found.heldout_after < np.maximum(NEAR * found.margin, EXPLAINED * found.heldout_before)
    if _structure_left(found):
        return "unexplained"
    if not causes or np.sqrt(share) > 2.0 * EXPLAINED or not near.any():
        return "unexplained"
    if causes[0].confounded_with or causes[0].confidence < HINT:
        return "ambiguous"
    return "explained" if np.sqrt(share) <= EXPLAINED or bool(near.all()) else "unexplained"


def _is_within(found: Identified) -> bool:
    """Whether no joint's gap matters, in training and held-out recordings, or is what a sound arm may have."""
    within = all(bool(np.all(gap < found.margin)) for gap in (found.train_before, found.heldout_before))
    moved = found.moved_train, found.moved_before
    within = within or all(bool(np.all(gap < found.margin)) for gap in moved)
    return within or found.sound


def _is_small(found: Identified) -> bool:
    """Whether no joint's gap is more than twice what matters, in training and held-out motion alike, in windows and
    running free."""
    free = (gap for gap in (found.moved_train, found.moved_before) if not np.isnan(gap).all())
    return all(bool(np.all(gap < NEAR * found.margin)) for gap in (found.train_before, found.heldout_before, *free))


def _structure_left(found: Identified) -> bool:
    """Whether the controller is unknown and some joint keeps a gap: then it may not be of the kind that was fitted."""
    return found.search.open_controller and bool(np.any(found.heldout_after > NEAR * found.margin))


def _cause(found: Identified, stage: Stage, share: float) -> Cause:
    effect, joints = stage.group
    names = found.sim.arm.names
    fall = stage.before - stage.after
    places = list(joints) or [int(np.argmax(fall))]
    before, after = (float(np.sqrt(np.mean(x[places] ** 2))) for x in (stage.before, stage.after))
    name, _, link = effect.partition("@")
    listed = tuple(names[j] for j in joints) or ((link,) if link else names)
    size = len(found.search.places_of((effect, joints[:1])))
    evidence = stage.evidence / max(PRICE * size, 1.0)
    confidence = ALMOST - (ALMOST - HINT) * float(np.exp(-0.35 * max(evidence - 1.0, 0.0)))
    if stage.rivals:
        confidence = min(confidence, 0.7)
    if _structure_left(found):
        confidence = min(confidence, HINT)
    return Cause(
        effect=name,
        joints=listed,
        parameters=_parameters(found, stage),
        gap_before=before,
        gap_after=after,
        confidence=confidence,
        fall=float(fall.max()),
        signs=Signs(
            stage.evidence, float((after / max(before, 1e-12)) ** 2), after / float(found.margin[places].max()), share
        ),
        confounded_with=stage.rivals,
        separate_by=SEPARATE.get(effect, OTHERWISE) if stage.rivals else None,
    )


def _parameters(found: Identified, stage: Stage) -> dict[str, dict[str, Value]]:
    effect, joints = stage.group
    if not joints:
        columns = [name for _, name in found.search.places_of(stage.group)]
        place = effect.partition("@")[2] or "arm"
        values = {c.partition(".")[2]: interval(found.search, found.fit, found.spread, -1, c) for c in columns}
        if effect == "link.payload":
            values |= {c.partition(".")[2]: payload_centre(found.fit, found.spread, c) for c in columns[1:]}
        return {place: values}
    own = EFFECTS[effect]
    return {
        found.sim.arm.names[j]: {
            called: interval(found.search, found.fit, found.spread, j, name)
            for name, called in zip(own.parameters, own.reported, strict=True)
        }
        for j in joints
    }


def _where(found: Identified) -> tuple[Location, ...]:
    """Position gap of each joint of the nominal model, largest first."""
    total = max(float((found.heldout_before**2).sum()), 1e-18)
    rows = [
        Location(name, "q", "other", float(rms), float(noise), float(rms**2 / total))
        for name, rms, noise in zip(found.sim.arm.names, found.heldout_before, found.search.floor, strict=True)
    ]
    return tuple(sorted(rows, key=lambda row: -row.rms))


def _rollout(found: Identified, taken: Sequence[tuple[Cause, Stage]]) -> Rollout | None:
    """Free-running replay of the nominal model, of what is exported, with its module if it has one, and of each cause
    that is in it alone and left out; those whose absence costs most first."""
    made = found.beside or found.export
    if made is None:
        return None
    groups = groups_of(found.fit, found.search)

    def gap(arm: Simulated, longest: float = LONGEST_S) -> Array:
        return replay_rms(arm, found.recordings, found.gains, longest)

    after = gap(simulated_model(found.sim, made))
    longest = max(float(r.t[-1] - r.t[0]) for r in found.recordings)
    effects, short = [], max(SHORT_S / len(found.recordings), EACH_S)
    for cause, stage in taken:
        if cause.effect not in WRITTEN or np.isnan(after).all():
            continue
        others = [group for group in groups if group != stage.group]
        alone, without = (
            gap(model_without(found.sim, found.search, made, some), short) for some in (others, [stage.group])
        )
        effects.append(EffectRollout(cause.effect, cause.joints, alone, without))
    effects.sort(key=lambda each: -float(np.nanmax(each.without)))
    return Rollout(longest, found.moved_before, after, tuple(effects), closed_loop=True)


# ---- notes: what positions leave open, and where the exported model is further off

FAR = 3.0
"""So many times what the fit leaves, or the margin, must a model leave that runs free, for a note."""
NEAR_A_ROW = 0.2
"""Share of the sampling period within which a time is taken for whole rows."""
MOST_NAMED = 4
"""Bodies that a note names."""
AT_TIMES = 0.01
"""Share of the held-out samples from which a note says that they are faster than any that was fitted."""


def notes(found: Identified) -> list[str]:
    """Notes on the controller, on limits that were not reached, and on effects that the exported model leaves out."""
    names = found.sim.arm.names
    kind = controller_name(found.fit) if found.search.open_controller else "position actuators as in the model"
    out = [
        f"there is no torque channel, so controller ({kind}) and effects are fitted to q_cmd and q, and the gap is in "
        "rad"
    ]
    if loose := undecided_scale(found.fit, found.spread):
        listed = ", ".join(names[j] for j in loose)
        out.append(
            f"{listed}: positions show only the ratios of gain, friction and inertia of these joints; the scale is "
            "taken from the inertia of the model: to measure the scale, hold a known load or record the current"
        )
    if any("viscous" in (own := found.fit.at(j)) and "back_emf" not in own for j in range(found.sim.n)):
        out.append(
            "viscous friction, back-EMF and velocity feedback have the same effect on positions, so only their sum is "
            "given" + (", as part of the controller" if found.search.open_controller else "")
        )
    if found.search.resting:
        listed = ", ".join(names[j] for j in sorted(found.search.resting))
        assumed = (
            "they are assumed to be held still by a controller"
            if found.search.open_controller
            else "the values of the model are kept"
        )
        out.append(f"{listed}: no training recording moves these joints, so nothing can be fitted for them: {assumed}")
    if limits := describe(found.spread.limits, names):
        out.append(f"the training motion does not reach these limits: {limits}")
    out += [*_early(found), *_held(found), *_ranges(found), *_beyond(found), *_faster(found), *_released(found)]
    left = effects_left_out(found.search, found.fit) if found.sim.path is not None else []
    if left:
        applied = [f"{effect} {joint}" for effect, joint, _ in found.beside.effects] if found.beside else []
        module = f"; a separate model with a module applies {', '.join(applied)}" if applied else ""
        out.append(f"the corrected model leaves out: {', '.join(left)}{module}")
    return out


def running_free(found: Identified, rollout: Rollout | None, *, gap: bool) -> list[str]:
    """Notes of a file that is written and leaves more than the nominal model, whether there is a `gap` or not, and of
    the joints at which it leaves much more of the gap than the fit."""
    if rollout is None:
        return []
    out = []
    if rollout.worse:
        before, after = (float(np.sqrt(np.mean(x**2))) for x in (rollout.before, rollout.after))
        out.append(
            "in a free-running simulation, the corrected model leaves a larger gap "
            f"({after:.3g} rad) than the nominal model ({before:.3g} rad): "
            + ("do not train with the corrected model, and record other motion" if gap else "use the nominal model")
        )
    left, least = rollout.after, np.maximum(found.heldout_after, found.margin)
    far = [
        f"{found.sim.arm.names[j]} {left[j]:.3g} rad (fit {found.heldout_after[j]:.3g})"
        for j in np.flatnonzero(left > FAR * least)
    ]
    told = "in a free-running simulation of the held-out motion, the corrected model leaves a larger gap than the fit"
    return [*out, *_note(told, far)]


def _note(told: str, where: Sequence[str], advice: str = "") -> list[str]:
    """A note with the places that it holds for; none without a place."""
    return [f"{told}: {', '.join(where)}" + (f": {advice}" if advice else "")] if where else []


def _early(found: Identified) -> list[str]:
    """A note of commands that act before their time, as those of rows with the position of a later row do."""
    early = {}
    for j in range(found.sim.n):
        if "delay" not in found.fit.at(j):
            continue
        late = interval(found.search, found.fit, found.within, j, "delay")
        if late.high < 0.0:
            early[found.sim.arm.names[j]] = late.value
    if not early:
        return []
    period, time = found.heldout.period, float(np.median([*early.values()]))
    rows = round(time / period)
    time = rows * period if rows and abs(time / period - rows) < NEAR_A_ROW else time
    listed = ", ".join(f"{name} {value:.3g} s" for name, value in early.items())
    return [
        f"commands take effect before the time of their rows ({listed}), which no controller can do: the rows hold the "
        f"position of a later time, or two clocks differ; correct the time with --clock q_cmd={time:.3g}"
    ]


def _held(found: Identified) -> list[str]:
    """A note of what lies outside of the arm and could move by itself."""
    held = held_parts(found.sim)
    told = "these parts of the model do not move and touch nothing, since they are not between --base and --tip"
    return _note(told, [*held[:MOST_NAMED], "…"] if len(held) > MOST_NAMED else held)


def _ranges(found: Identified) -> list[str]:
    """A note of joints that go further than the model lets them."""
    names, own = found.sim.arm.names, found.sim.mujoco_model.jnt_range[list(found.sim.joints)]
    out = [
        f"{names[j]} (model {own[j, 0]:.2f} to {own[j, 1]:.2f} rad, corrected {low:.2f} to {high:.2f} rad)"
        for j in widened_joints(found.sim)
        for low, high in [found.sim.arm.range[j]]
    ]
    return _note("these joints move beyond the joint range of the model, where a simulation would stop them", out)


def _beyond(found: Identified) -> list[str]:
    """A note of the joints that leave the range of the training recordings more often than a band may miss."""
    out = []
    for j, name in enumerate(found.sim.arm.names):
        fitted, other = (d.measured[:, j][d.weight[:, j] > 0.0] for d in (found.search.data, found.heldout))
        if not (fitted.size and other.size):
            continue
        outside = float(np.mean((other < fitted.min()) | (other > fitted.max())))
        if outside > 1.0 - SHARE:
            out.append(f"{name}: {outside:.0%} of the held-out motion")
    told = "these joints move outside of the range of the training recordings, where the band may be too narrow"
    return _note(told, out)


def _faster(found: Identified) -> list[str]:
    """A note of the joints that are at times faster than in what is fitted of the training."""
    out = []
    for j, name in enumerate(found.sim.arm.names):
        fitted, other = (np.abs(d.v[:, j][d.weight[:, j] > 0.0]) for d in (found.search.data, found.heldout))
        if not (fitted.size and other.size):
            continue
        if np.mean(other > fitted.max()) > AT_TIMES:
            out.append(f"{name} up to {other.max():.2g} rad/s (in training {fitted.max():.2g})")
    told = "the held-out motion is faster than all training motion, so the fit may not hold for it"
    return _note(told, out, "add faster motion to --train")


def _released(found: Identified) -> list[str]:
    """A note of the joints whose servo is off at times in the held-out motion and never in what is fitted."""
    off = [1.0 - data.served.mean((0, 2)) for data in (found.search.data, found.heldout)]
    out = [
        f"{name} for {100.0 * off[1][j]:.0f} % of the time"
        for j, name in enumerate(found.sim.arm.names)
        if off[0][j] == 0.0 < off[1][j]
    ]
    told = "the servo is off in part of the held-out motion, but never in training, so the fit may not hold there"
    return _note(told, out, "add such a recording, with the servo off, to --train")
