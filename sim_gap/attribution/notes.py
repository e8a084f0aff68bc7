"""What a diagnosis says besides its causes, a line each: what is odd, what else it may be, what is left."""

from collections.abc import Sequence

from sim_gap.attribution.diagnosis import Cause
from sim_gap.attribution.verdict import row_rms
from sim_gap.effects.laws import LAWS
from sim_gap.effects.registry import Row
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.residuals.stuck_channels import Stuck
from sim_gap.residuals.where import places
from sim_gap.search.estimate import Estimate

ALIKE = 0.05
"""A general law that does worse than a cause by less is told of."""
TOLD = 3
"""So many rows in which something is left are told of."""


def notes(
    found: Sequence[Cause],
    stuck: Sequence[Stuck],
    estimate: Estimate | None,
    fit: ResidualSet,
    judge: ResidualSet,
    left: dict[Row, Array],
) -> tuple[str, ...]:
    """All lines; `fit` was fitted, `judge` was not, and of the latter this is `left`."""
    known = (*_drowned(fit), *_stuck(stuck, fit), *_hits(fit), *_bound(estimate, fit), *_alike(found))
    return (*known, *_left(judge, left), *_still(fit))


def _drowned(data: ResidualSet) -> tuple[str, ...]:
    """A line for each joint whose command is compared beyond channels that are noisy."""
    layout, names = data.layout, data.signals[0].arm.names
    return tuple(
        f"{names[j]}: {' and '.join(layout.chain[: layout.beyond(j)])} drown in noise: the command is compared with "
        f"{layout.reference((str(layout.command), j)) or 'the model'} instead"
        for j in range(layout.n)
        if layout.beyond(j)
    )


def _stuck(stuck: Sequence[Stuck], data: ResidualSet) -> tuple[str, ...]:
    names = data.signals[0].arm.names
    told = (
        f"{names[one.joint]}: {one.channel} repeats one number for {one.seconds:.3g} s while the arm moves: stuck "
        "sensor or channel; this recording cannot tell what it should read, and those moments are left out"
        for one in stuck
    )
    return tuple(dict.fromkeys(told))


def _hits(data: ResidualSet) -> tuple[str, ...]:
    return tuple(
        f"{data.signals[0].arm.names[joint]}: the torque jumps where it changes sign, as a gear with play does; "
        f"these moments ({near.mean():.0%} of the time) are left out of the comparison"
        for joint, near in data.struck.items()
    )


def _bound(estimate: Estimate | None, data: ResidualSet) -> tuple[str, ...]:
    """A line for what is in one recording alone, and for a payload that could be in part the links' own weight."""
    terms = () if estimate is None else estimate.terms
    labels = {s.number: s.label for s in data.signals}
    lines = [f"{term.effect} is in {labels[term.bound]} alone" for term in terms if term.bound]
    if any(term.effect == "link.payload" and not term.bound for term in terms):
        lines.append(
            "link.payload: what the links themselves weigh beyond the model counts to it; recordings of the arm "
            "without the payload, given as well (--train), tell the two apart"
        )
    return tuple(lines)


def _alike(found: Sequence[Cause]) -> tuple[str, ...]:
    """A line for each cause that a general law could stand in for."""
    return tuple(
        f"{cause.effect}: {LAWS[cause.law].told} would look the same in this motion; the true cause may be none that "
        "is known here"
        for cause in found
        if cause.signs.outside < ALIKE
    )


def _left(data: ResidualSet, left: dict[Row, Array]) -> tuple[str, ...]:
    """A line for the rows in which most is left, and what it goes with, where that is a gap still."""
    above = [row for row, rms in row_rms(data, left).items() if rms > data.margin[row]]
    return tuple(
        f"{place.joint}: {place.rms:.2g} N·m of {place.channel} are left (noise {place.noise:.2g}), which go with "
        + ("nothing that is looked for here" if place.regime == "other" else f"{place.regime} ({place.share:.0%})")
        for place in (places(data, left, above)[:TOLD] if above else [])
    )


def _still(data: ResidualSet) -> tuple[str, ...]:
    still = [
        f"{data.signals[0].arm.names[joint]} hardly moves: its {channel} tells nothing of friction here"
        for channel, joint in data.rows
        if channel == data.layout.motor and not any(s.moving[:, joint].mean() > 0.02 for s in data.signals)
    ]
    return tuple(still)
