"""Notes of an answer from positions alone: what they leave open, and where the exported model is further off."""

from collections.abc import Sequence

import numpy as np

from sim_gap.attribution.diagnosis import Rollout
from sim_gap.position_gap.identify import Identified
from sim_gap.position_gap.plant import held_parts
from sim_gap.position_gap.start import controller_name
from sim_gap.position_gap.training.bands import SHARE
from sim_gap.position_gap.training.export import effects_left_out, widened_joints
from sim_gap.position_gap.training.spread import interval, undecided_scale
from sim_gap.position_gap.training.unreached_limits import describe

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
        value, _, high, _ = interval(found.search, found.fit, found.within, j, "delay")
        if high < 0.0:
            early[found.sim.arm.names[j]] = value
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
