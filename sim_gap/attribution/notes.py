"""Notes of a diagnosis, one line each: anomalies of the data, other possible causes, remaining residuals."""

from collections.abc import Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.attribution.bodies import recordings_with
from sim_gap.attribution.diagnosis import Cause
from sim_gap.attribution.residual_laws import ResidualLaw
from sim_gap.attribution.rivals import AS_GOOD
from sim_gap.effects.registry import LAWS
from sim_gap.residuals.channel_quality import Stuck
from sim_gap.residuals.layout import Row
from sim_gap.residuals.preprocess import ABSENT, TRIM_S
from sim_gap.residuals.residual_set import Location, ResidualSet, locate, row_rms
from sim_gap.search.estimate import NOMINAL, EffectEstimate
from sim_gap.search.term import BODY, CONSTANT, MASSES, shares_a_factor

WORSE = 1.1
"""Gap with the corrections over the one without them from which the corrections do not carry over; a choice."""


def notes(
    found: Sequence[Cause],
    stuck: Sequence[Stuck],
    estimate: EffectEstimate,
    fit: ResidualSet,
    judge: ResidualSet,
    left: dict[Row, Array],
) -> tuple[str, ...]:
    """All notes; `fit` is the training set, `judge` the held-out set with the remaining residual `left`."""
    usual = (*_noisy(fit), *_spiked((fit, judge)), *_stuck(stuck, fit), *_impacts(fit), *_disturbed((fit, judge)))
    known = (
        *usual,
        *_at_bounds(estimate, fit),
        *_common_factor(found, estimate, fit),
        *_bound(estimate, fit, judge),
        *_alike(found),
    )
    return (*known, *_remaining(judge, left), *_at_rest(fit))


def _noisy(data: ResidualSet) -> tuple[str, ...]:
    layout, names = data.layout, data.signals[0].arm.names
    return tuple(
        f"{names[j]}: the noise of {' and '.join(layout.chain[: layout.beyond(j)])} is too large; the "
        f"command is compared with {layout.reference((str(layout.command), j)) or 'the model'} instead"
        for j in range(layout.n)
        if layout.beyond(j)
    )


def _stuck(stuck: Sequence[Stuck], data: ResidualSet) -> tuple[str, ...]:
    names = data.signals[0].arm.names
    lines = (
        f"{names[one.joint]}: {one.channel} repeats one value for {one.seconds:.3g} s while the arm moves: the "
        "sensor or the channel is stuck; these samples are left out"
        for one in stuck
    )
    return tuple(dict.fromkeys(lines))


def _spiked(sets: Sequence[ResidualSet]) -> tuple[str, ...]:
    """A note for each channel with isolated spikes: how many samples of which joints are left out."""
    every = [(s.arm.names[one.joint], one) for data in sets for s in data.signals for one in s.spikes]
    lines = []
    for channel in dict.fromkeys(one.channel for _, one in every):
        ours = [(name, one) for name, one in every if one.channel == channel]
        count, readings = (sum(getattr(one, part) for _, one in ours) for part in ("count", "readings"))
        joints = {name: sum(one.count for other, one in ours if other == name) for name, _ in ours}
        lines.append(
            f"{channel}: {count} of {readings} samples ({count / readings:.2%}) are left out as spikes, "
            "since they are far from the samples before and after "
            f"({', '.join(f'{name} {number}' for name, number in joints.items())})"
        )
    return tuple(lines)


def _impacts(data: ResidualSet) -> tuple[str, ...]:
    return tuple(
        f"{data.signals[0].arm.names[joint]}: the torque jumps when it changes sign, as in a gear with backlash; these "
        f"samples ({near.mean():.0%} of the time) are left out of the comparison"
        for joint, near in data.impacts.items()
    )


def _disturbed(sets: Sequence[ResidualSet]) -> tuple[str, ...]:
    lines = (
        f"{s.label}: at {one.start:.1f} s, and at no other time, several joints differ suddenly from the "
        f"fit, {s.arm.names[one.joint]} by {one.torque:.2g} N·m: something touched the arm, or torques were "
        f"misread; {one.end - one.start + 2.0 * TRIM_S:.1f} s are left out"
        for data in sets
        for s in data.signals
        for one in s.disturbances
    )
    return tuple(dict.fromkeys(lines))


def _at_bounds(estimate: EffectEstimate, fit: ResidualSet) -> tuple[str, ...]:
    names = fit.signals[0].arm.names
    return tuple(
        f"{term.effect} of {'the arm' if term.form.signature.whole_arm else names[term.place]} has reached "
        "the largest or smallest possible value: these recordings do not determine its size"
        for term in estimate.at_bounds()
    )


def _common_factor(found: Sequence[Cause], estimate: EffectEstimate, fit: ResidualSet) -> tuple[str, ...]:
    """A note for torque constants, or masses, that motor torque alone tells: only their products are known."""
    alike = {MASSES: CONSTANT, BODY: CONSTANT, CONSTANT: MASSES}
    if cause := next((each for each in found if alike.get(each.effect) in each.confounded_with), None):
        return (
            f"{cause.effect}: {fit.layout.motor} alone shows only the products of masses and torque constants: if all "
            "constants were wrong by one factor, the recordings would look the same; creep sweeps with a weighed mass "
            "show whether the masses or the constants are wrong",
        )
    if not shares_a_factor(fit.layout, estimate.terms):
        return ()
    return (
        f"{CONSTANT}: {fit.layout.motor} alone does not determine the common scale of masses and torque constants: if "
        "all links are 1 % heavier than in the model, then all constants, friction and rotor inertias are 1 % larger; "
        f"the intervals allow for masses that are wrong by {2 * NOMINAL:.0%}; creep sweeps with a weighed mass "
        "determine the scale",
    )


def _bound(estimate: EffectEstimate, fit: ResidualSet, judge: ResidualSet) -> tuple[str, ...]:
    """A note for effects in some recordings alone, and for a payload that includes model errors of the links."""
    lines = []
    for term in estimate.terms:
        if alone := recordings_with(term, (fit, judge)):
            lines.append(f"{term.effect} is present only in {' and '.join(alone)}")
        elif term.effect == "link.payload":
            lines.append(
                "link.payload: this payload includes mass errors of the links; to separate the two, add "
                "recordings of the arm without the payload (--train)"
            )
        if term.effect == "link.payload":
            lines += _turned((fit, judge))
            if estimate.of(term)[0] < 0.0:
                lines.append(
                    "link.payload: its mass is negative, so the model has a body at its tip that the arm lacks"
                )
    return tuple(lines)


def _turned(sets: Sequence[ResidualSet]) -> list[str]:
    return [
        f"link.payload: in {s.label} the payload is turned by {np.degrees(s.mount):.0f}° about the axis of "
        f"{s.arm.names[-1]}, compared with the other recordings; the angle was found from this recording"
        for s in dict.fromkeys(s for data in sets for s in data.signals)
        if s.mount and s.number != ABSENT
    ]


def _alike(found: Sequence[Cause]) -> tuple[str, ...]:
    return tuple(
        f"{cause.effect}: {LAWS[cause.law].description} would look the same in this motion; the true cause may be "
        "unknown to armlink"
        for cause in found
        if cause.signs.outside < AS_GOOD
    )


def _remaining(data: ResidualSet, left: dict[Row, Array]) -> tuple[str, ...]:
    """A note for the rows with the largest remaining gaps, and the regime of motion of each."""
    above = [row for row, rms in row_rms(data, left).items() if rms > data.margin[row]]
    return tuple(
        f"{at.joint}: a gap of {at.rms:.2g} N·m in {at.channel} remains (noise {at.noise:.2g} N·m), "
        + ("in no clear regime of motion" if at.regime == "other" else f"correlated with {at.regime} ({at.share:.0%})")
        for at in (locate(data, left, above)[:3] if above else [])
    )


def worse_notes(names: Sequence[str], before: Array, after: Array, margin: Array) -> list[str]:
    """Joints whose held-out gap [N·m] (n,) grows by what was fitted."""
    return [
        f"{name}: the fitted effects increase the held-out gap, from {old:.2g} to {new:.2g} N·m: leave these "
        "effects of this joint out of the model, and record more of its motion"
        for name, old, new, least in zip(names, before, after, margin, strict=True)
        if new > WORSE * old and new > least
    ]


def _at_rest(data: ResidualSet) -> tuple[str, ...]:
    return tuple(
        f"{data.signals[0].arm.names[joint]} hardly moves: its {channel} contains no information on friction"
        for channel, joint in data.rows
        if channel == data.layout.motor and not any(s.moving[:, joint].mean() > 0.02 for s in data.signals)
    )


def aside_notes(aside: Sequence[Location]) -> tuple[str, ...]:
    """A note for each gap at rest, in creep or above the band that nothing known accounts for."""
    where = {"rest": "at rest", "creep": "in creep and around reversals"}
    return tuple(
        f"{at.joint}: a gap of {at.rms:.2g} N·m in {at.channel} "
        + (
            f"at {at.hz:.3g} Hz, a hum or a resonance above the frequencies that are compared"
            if at.hz
            else f"{where[at.regime]}, more than known friction explains: breakaway, hysteresis or backlash"
        )
        for at in aside
        if at.clear
    )


def law_notes(laws: Sequence[ResidualLaw], names: Sequence[str]) -> tuple[str, ...]:
    return tuple(
        f"{names[law.joint]}: the remaining gap in {law.channel} depends on the joint's {law.quantity}"
        + (", directed against the motion" if law.directed else "")
        + f"; this law reduces the gap on held-out data from {law.before:.2g} to {law.after:.2g} N·m, and "
        "no known effect explains it"
        for law in laws
    )
