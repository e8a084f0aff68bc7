"""Scales of a drive's readings, judged by readings alone: which of position, velocity and torque is off, and how far.

With s the factor by which a quantity is truly coded larger than its decoder takes it (so that it reads 1/s of what it
is), each piece of evidence is a ratio that sound scales make 1:

- velocity integrated over time, against the change of position: s_position / s_velocity;
- the way between the stops, against that of the arm file: 1 / s_position;
- torque against the law kp (q* − q) + kd (v* − v) + τ of a drive that was given gains: s_position / s_torque for its
  stiffness, s_velocity / s_torque for its damping;
- torque against current times torque constant: 1 / s_torque.

The fewest scales that explain all ratios are named. Pure: arrays in, findings out.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from armlink.arrays import Array


@dataclass(frozen=True, eq=False)
class ScaleTrack:
    """Readings of one joint and what was commanded at the time, all (K,), NaN where there was none."""

    t: Array
    """[s]."""
    position: Array
    """[rad]."""
    velocity: Array
    """[rad/s]."""
    torque: Array
    """Motor torque as the drive reports it [N·m], no calibration applied."""
    target: Array
    """Commanded position [rad]."""
    rate: Array
    """Commanded velocity [rad/s]."""
    ahead: Array
    """Commanded torque [N·m]."""
    kp: Array
    """[N·m/rad]."""
    kd: Array
    """[N·m·s/rad]."""


QUANTITIES = ("position", "velocity", "torque")
SCALE_TOLERANCE = math.log(1.06)
"""Scales closer than this to 1 are sound: with what ratios scatter, ten per cent are found and sound ones are not."""
RATIO_SIGMA = 0.012
"""Least standard deviation of the logarithm of a ratio: delays, rounding, friction."""
DAMPING_SIGMA = 0.05
"""The same of the damping that torque follows: it is found 10 % off where the position of its joint is; a choice."""
SCALE_PRICE = 16.0
"""A further scale must explain this much of the sum of squares."""
RIVAL_MARGIN = 4.0
"""Explanations of as many scales within this much of the best cannot be told apart."""
WINDOW = 0.25
"""Velocity is integrated over windows of this length [s]."""
LONGEST_GAP = 0.05
"""Readings further apart are not integrated across [s]."""
LEAST_TURN = 0.01
"""A window in which the joint turned less tells nothing [rad]."""
LEAST_WAY = 0.3
"""All windows together must cover this much [rad]."""
UNSTEADY_SCATTER = 0.25
"""Relative scatter of the windows' ratios from which a velocity is no velocity."""
LEAST_ROWS = 200
"""Samples with gains that the law needs."""
LAW_SIGMA = 0.02
"""A coefficient of the law counts if it is known to this, relative to 1."""
PAST_STOP = 1.03
"""A way longer than that between the stops cannot be true, whoever moved the joint."""


@dataclass(frozen=True)
class Evidence:
    text: str
    ratio: float
    sigma: float
    """Of its logarithm."""
    exponents: dict[str, int]
    """Quantity → power of its s in the ratio."""


@dataclass(frozen=True)
class ScaleFinding:
    quantities: tuple[str, ...]
    """The quantity; several if the evidence cannot tell which of them."""
    factor: float
    """s of it: it reads 1 / factor of what it is; NaN if its readings are unsteady."""
    evidence: tuple[str, ...] = field(default=())

    @property
    def text(self) -> str:
        what, why = " or ".join(self.quantities), "; ".join(self.evidence)
        if math.isnan(self.factor):
            return f"the reading of {what} is unsteady: {why}"
        return f"{what} reads {1 / self.factor:.3g} times its true value ({why})"


def gather_evidence(
    track: ScaleTrack, way: float, stop_to_stop: bool, by_current: Sequence[tuple[float, float]]
) -> list[Evidence]:
    """All evidence of one joint.

    `way` is the angle between its stops [rad]; `stop_to_stop`: it was moved from one to the other. `by_current` has
    pairs of a reported torque and of current times torque constant [N·m].
    """
    stops, current = stops_evidence(track, way, stop_to_stop), current_evidence(by_current)
    found = [velocity_evidence(track), *law_evidence(track), stops, current]
    return [each for each in found if each is not None]


def judge_scales(evidence: Sequence[Evidence]) -> list[ScaleFinding]:
    """The fewest scales that explain the evidence; none where all ratios are 1."""
    unsteady = [each for each in evidence if not each.ratio > 0]
    if unsteady:
        return [ScaleFinding(("velocity",), math.nan, tuple(each.text for each in unsteady))]
    if not evidence:
        return []
    y = np.array([math.log(each.ratio) / each.sigma for each in evidence])
    a = np.array([[each.exponents.get(name, 0) / each.sigma for name in QUANTITIES] for each in evidence])
    costs: dict[tuple[int, ...], tuple[float, Array]] = {(): (float(y @ y), np.zeros(0))}
    for size in (1, 2):
        for chosen in itertools.combinations(range(len(QUANTITIES)), size):
            columns = a[:, list(chosen)]
            if np.linalg.matrix_rank(columns) < size:
                continue
            log_s, *_ = np.linalg.lstsq(columns, y, rcond=None)
            if (np.abs(log_s) >= SCALE_TOLERANCE).all():
                left = y - columns @ log_s
                costs[chosen] = float(left @ left) + SCALE_PRICE * size, log_s
    best = min(costs, key=lambda chosen: costs[chosen][0])
    if not best:
        return []
    rivals = [each for each in costs if len(each) == len(best) and costs[each][0] <= costs[best][0] + RIVAL_MARGIN]
    texts = tuple(each.text for each in evidence if abs(math.log(each.ratio)) >= SCALE_TOLERANCE / 2)
    if len(best) == 1:
        names = tuple(QUANTITIES[each[0]] for each in rivals)
        return [ScaleFinding(names, math.exp(float(costs[best][1][0])), texts)]
    return [
        ScaleFinding((QUANTITIES[which],), math.exp(float(log_s)), texts)
        for which, log_s in zip(best, costs[best][1], strict=True)
    ]


def velocity_evidence(track: ScaleTrack) -> Evidence | None:
    """Velocity integrated over time against the change of position; None where the joint hardly moved."""
    both = np.isfinite(track.position) & np.isfinite(track.velocity)
    t, q, v = track.t[both], track.position[both], track.velocity[both]
    if len(t) < 3:
        return None
    step = np.diff(t)
    piece = 0.5 * (v[1:] + v[:-1]) * step
    window = np.floor((t[1:] - t[0]) / WINDOW).astype(int)
    good = (step > 0) & (step <= LONGEST_GAP)
    count = int(window[-1]) + 1
    turned = np.bincount(window[good], np.diff(q)[good], count)
    summed = np.bincount(window[good], piece[good], count)
    moved = np.abs(turned) >= LEAST_TURN
    turned, summed = turned[moved], summed[moved]
    way = float(np.abs(turned).sum())
    if way < LEAST_WAY:
        return None
    ratio = _median(summed / turned, np.abs(turned))
    scatter = 1.483 * _median(np.abs(summed / turned - ratio), np.abs(turned))
    text = f"the velocity, integrated over {way:.2f} rad of motion, gives {ratio * way:.2f} rad"
    if ratio <= 0 or scatter > UNSTEADY_SCATTER * abs(ratio):
        text = f"{text}, scattering by {scatter / max(abs(ratio), 1e-9):.0%}"
        return Evidence(text, -1.0, RATIO_SIGMA, {"velocity": -1})
    sigma = max(RATIO_SIGMA, scatter / abs(ratio) / math.sqrt(len(turned)))
    return Evidence(text, ratio, sigma, {"position": 1, "velocity": -1})


def _median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, 0.5 * share[-1])])


def _rounding(values: Array) -> float:
    """Standard deviation of a reading's rounding, from the smallest step that it shows."""
    steps = np.diff(np.unique(values[np.isfinite(values)]))
    return float(steps.min()) / math.sqrt(12.0) if len(steps) else 0.0


def law_evidence(track: ScaleTrack) -> list[Evidence]:
    """Torque against the law of gains, the command of the sample before with the readings of the torque's own sample;
    only coefficients that the motion shows."""
    stiff = track.kp[:-1] * (track.target[:-1] - track.position[1:])
    damped = track.kd[:-1] * (track.rate[:-1] - track.velocity[1:])
    columns = np.column_stack([stiff, damped])
    torque, told = track.torque[1:], track.ahead[:-1]
    rows = np.isfinite(columns).all(axis=1) & np.isfinite(torque + told) & (track.kp[:-1] > 0)
    if rows.sum() < LEAST_ROWS:
        return []
    late = (track.kp[:-1] * track.velocity[1:])[rows]  # the torque was measured a little before the position
    design = np.column_stack([columns[rows], told[rows], np.ones(int(rows.sum())), late])
    rounding = np.array(
        [
            (_rounding(track.position) * track.kp[:-1][rows]).mean(),
            (_rounding(track.velocity) * track.kd[:-1][rows]).mean(),
        ]
    )
    stiffness, damping = _coefficients(design, torque[rows], rounding)
    if not damping.known:  # what the damping really is would change the stiffness that is found
        fixed = _coefficients(design[:, [0, 2, 3, 4]], torque[rows] - design[:, 1], rounding[:1])[0]
        share = min(1.0, 2 * damping.sigma / max(abs(damping.value - 1), 1e-9))
        stiffness = replace(stiffness, sigma=math.hypot(stiffness.sigma, share * (stiffness.value - fixed.value)))
    found = []
    for name, each, exponents, floor in (
        ("stiffness", stiffness, {"position": 1, "torque": -1}, RATIO_SIGMA),
        ("damping", damping, {"velocity": 1, "torque": -1}, DAMPING_SIGMA),
    ):
        if each.known:
            text = f"the torque shows a {name} of {each.value:.3g} times the commanded {name}"
            found.append(Evidence(text, each.value, max(floor, 2 * each.sigma / each.value), exponents))
    return found


@dataclass(frozen=True)
class _Coefficient:
    value: float
    sigma: float

    @property
    def known(self) -> bool:
        return self.value > 0 and self.sigma <= LAW_SIGMA * max(1.0, self.value)


def _coefficients(design: Array, torque: Array, rounding: Array) -> list[_Coefficient]:
    """The first coefficients of a linear fit; rounding of a reading flattens its coefficient by the share that it has
    in what the motion shows of that reading alone."""
    answer, *_ = np.linalg.lstsq(design, torque, rcond=None)
    left = torque - design @ answer
    variance = float(left @ left) / max(len(left) - design.shape[1], 1)
    found = []
    for column, noise in enumerate(rounding):
        others = np.delete(design, column, axis=1)
        alone = design[:, column] - others @ np.linalg.lstsq(others, design[:, column], rcond=None)[0]
        shown = float(alone @ alone)
        sigma = math.hypot(math.sqrt(variance / shown), noise**2 * len(left) / shown) if shown > 1e-9 else math.inf
        found.append(_Coefficient(float(answer[column]), sigma))
    return found


def stops_evidence(track: ScaleTrack, way: float, stop_to_stop: bool) -> Evidence | None:
    """The way that was covered against that between the stops; None where it tells nothing."""
    here = track.position[np.isfinite(track.position)]
    if not len(here) or not way > 0:
        return None
    covered = float(here.max() - here.min())
    if not stop_to_stop and covered <= PAST_STOP * way:
        return None
    text = f"the joint read {covered:.2f} rad between its stops, but the arm file has {way:.2f} rad"
    return Evidence(text, covered / way, RATIO_SIGMA, {"position": -1})


def current_evidence(pairs: Sequence[tuple[float, float]]) -> Evidence | None:
    """Reported torques against current times torque constant; None without any that is known."""
    known = np.array([pair for pair in pairs if all(math.isfinite(value) for value in pair)])
    if len(known) < 3 or not np.abs(known[:, 1]).max() > 0:
        return None
    torque, expected = known.T
    ratio = float((torque * expected).sum() / (expected**2).sum())
    left = torque - ratio * expected
    sigma = math.sqrt(float((left**2).mean()) / float((expected**2).sum())) / max(abs(ratio), 1e-9)
    if ratio <= 0 or sigma > LAW_SIGMA:
        return None
    text = f"the torque that it reports is {ratio:.3g} × current × torque constant"
    return Evidence(text, ratio, max(RATIO_SIGMA, sigma), {"torque": -1})
