"""Order, sign, zero and angle unit of the columns, judged by the model: which change makes the data fit it?

Each hypothesis changes the data in one way. It is accepted if what the model leaves unexplained falls by far more than
wrong masses, friction or a tilted base could explain, and the data fit well with it. On recordings of sound arms no
hypothesis comes near; a change that the model cannot see (the zero of a vertical first joint) makes no difference to
the diagnosis either.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlink.recording.corrections import Corrections
from gcomp.arrays import Array
from sim_gap.checks.column_order import likely_orders
from sim_gap.checks.finding import RecordingFinding
from sim_gap.checks.hypotheses import Hypothesis, hypotheses, put_in_order
from sim_gap.checks.mounting import find_load, find_mounting
from sim_gap.checks.rigid_fit import (
    FEW,
    SCREENED,
    STRONG_SHARE,
    ChannelMotion,
    RigidFit,
    fit_model,
    fit_models,
    fit_rigid,
    rows_of,
)
from sim_gap.checks.small_zero import least_cost
from sim_gap.model.rigid_body import RigidArm

SURE = 0.3
"""Fall of the summed cost from which a hypothesis is accepted; a wrong one stays below 0.15 on sound recordings."""
DOUBTED = 0.4
"""Fall from which one that makes a joint much worse, or contradicts the model, is asked about; on sound recordings no
hypothesis at all reaches 0.25."""
CERTAIN = 1.0
"""Fall below which a change is asked about if a joint that it concerns is not explained then, or only by a coefficient
that no arm has, or if any other change does as much: it may be chance, of a hundred changes and weak joints. Likewise
of the thousands of orders of more than two joints."""
TWICE = 2.0
"""Times a fall by which that of a change that is doubted must be larger to be asked about instead."""
ALIKE = 0.05
"""Difference of the falls below which two changes cannot be told from each other."""
NEARLY = 0.4
"""Difference of the falls below which an order is not certain beside another that moves no more joints: first joint and
wrist of a UR10 exchanged are 0.3 apart."""
MOST_OPTIONS = 2
"""Most options that are spelt out."""
MOST_WORSE = 0.5
"""Most that the cost of any joint may rise with a hypothesis, as a share of the fall of all."""
FITS = 0.65
"""Share of variance that the joints concerned must have explained after a correction (median), and strong ones each."""
PLAUSIBLE = 0.4, 2.5
"""Coefficient of the model's torque on a strong joint after a correction."""
IDLE = 0.5
"""The model's own part over the reading from which a motor is all but idle, if the reading does not hold that part."""
SLIGHT = 0.02
"""Share of the reading that the model's own part must have, with a plausible coefficient, for a joint to count."""
SPRUNG = 0.97
"""Share of variance explained from which a joint has a spring; a turned sign looks like one by less."""


@dataclass(frozen=True, eq=False)
class HypothesisTest:
    """A hypothesis beside the data as they were."""

    hypothesis: Hypothesis
    fit: RigidFit
    """The fit with it."""
    fall: float
    """Fall of the cost over all joints, as far as it tells (`_told`)."""
    doubted: bool
    """Whether a joint is much worse with it, or contradicts the model."""
    others: tuple[Hypothesis, ...] = ()
    """Other changes with which the data fit as well."""


def find_mapping(
    arm: RigidArm,
    motion: ChannelMotion,
    stated: Corrections,
    follows: Sequence[str] = (),
    mounted: RigidArm | None = None,
) -> list[RecordingFinding]:
    """Findings on order, sign, zero and angle unit of a motion, one after the other.

    `mounted` is what `find_mounting` gives for this motion, if it is known. `follows` are the channels (of `dq`,
    `q_cmd`) whose columns agree with the positions' as they are recorded, so that what is wrong with a position is
    wrong with theirs. All findings are corrected, or none is. A slight fall counts only if every joint
    concerned is explained then, and one that is not large is certain only then: a model that was fitted to another
    motion leaves some of them to chance.
    """
    fit = _as_an_arm(mounted or find_mounting(arm, motion), motion)
    orders = _orders(arm, motion, stated, follows) if _is_odd(fit) else []
    taken: list[HypothesisTest] = []
    while len(taken) < 2 * arm.n and not (taken and taken[-1].doubted):
        first = [] if taken else orders
        best = _best(arm, motion, fit, [*hypotheses(arm, motion, stated, follows), *first])
        if best is None or _is_small_zero(arm, motion, fit, best):
            break
        motion, fit = best.hypothesis.change(motion), best.fit
        taken.append(best)
    touched = {joint for each in taken for joint in each.hypothesis.joints}
    sound = not any(each.doubted for each in taken) and _is_sound(fit, touched)
    explained = sound and bool(np.all(fit.explained[list(touched)] > FITS))
    if sum(each.fall for each in taken) < DOUBTED and not explained:
        return []
    if any(_is_of_many(each) for each in taken):
        sound = explained
    if any(each.fall < CERTAIN for each in taken):
        sound = explained and _is_plausible(fit, touched)
    sure = sound and not any(each.others for each in taken)
    return [_finding(arm, each, fit, sure) for each in taken]


def _is_odd(fit: RigidFit) -> bool:
    """Whether a joint is not explained, or contradicts the model: then every order is looked at."""
    return bool(np.any(fit.explained < FITS)) or any(_contradicts(fit, [j]) for j in range(len(fit.scale)))


def _orders(arm: RigidArm, motion: ChannelMotion, stated: Corrections, follows: Sequence[str]) -> list[Hypothesis]:
    """Orders of all joints' columns, of their positions and of their torques that fit best."""
    if stated.order or stated.joints:
        return []
    positions, torque = ("q", *follows), motion.channel
    return [
        put_in_order(arm, order, (*(positions if moved else ()), *((torque,) if read else ())), torque)
        for order, moved, read in likely_orders(arm, motion)
    ]


def _as_an_arm(mounted: RigidArm, motion: ChannelMotion) -> RigidFit:
    """The fit as it stands, gravity, a tool and springs included where they explain it: effects of the arm."""
    model = find_load(mounted, motion).carried(motion.q, motion.v, motion.a)
    plain, sprung = fit_model(model, motion), fit_model(model, motion, springs=True)
    beside = (sprung.scale > PLAUSIBLE[0]) | (sprung.own_share < STRONG_SHARE)  # not in place of gravity
    return replace(plain, explained=np.where(beside & (sprung.explained > SPRUNG), sprung.explained, plain.explained))


def _best(arm: RigidArm, motion: ChannelMotion, fit: RigidFit, possible: Sequence[Hypothesis]) -> HypothesisTest | None:
    """The hypothesis that lowers the cost most, if by enough; one that is doubted only if it does so by far more."""
    found = []
    for hypothesis, screened in zip(
        possible, _screened(arm, rows_of(motion, slice(None, None, FEW)), possible), strict=True
    ):
        if float((fit.cost - screened.cost).sum()) < SCREENED * SURE:
            continue
        moved = hypothesis.change(motion)
        better = fit_rigid(arm, moved)
        fall = float(_told(hypothesis, moved, fit, better).sum())
        worse = float(np.max(better.cost - fit.cost))
        settled = _contradicts(fit, hypothesis.joints)  # which it no longer does
        doubted = (worse >= MOST_WORSE * fall and not settled) or _contradicts(better, hypothesis.joints)
        if fall > (DOUBTED if doubted else SURE):
            found.append(HypothesisTest(hypothesis, better, fall, doubted))
    return _likeliest(found) if found else None


def _likeliest(found: Sequence[HypothesisTest]) -> HypothesisTest:
    """The change that explains most, of orders that explain as much the one of fewest joints; with the others beside
    it that it cannot be told from."""
    best = max(found, key=lambda each: each.fall if each.doubted else TWICE * each.fall)
    as_good = [each for each in found if _is_near(each, best, ALIKE) and each.doubted == best.doubted]
    best = min(as_good, key=lambda each: (len(each.hypothesis.joints), -each.fall), default=best)
    own = best.hypothesis
    alike = [each.hypothesis for each in found if each.fall > best.fall - ALIKE and not each.doubted]
    if best.fall > CERTAIN:
        alike = [h for h in alike if h.kind == own.kind and h.joints == own.joints and h.channels != own.channels]
        alike += [each.hypothesis for each in found if _is_near(each, best, NEARLY)]
    others = {h.option: h for h in alike if h.option != own.option}
    return replace(best, others=tuple(others.values()))


def _is_near(change: HypothesisTest, best: HypothesisTest, margin: float) -> bool:
    """Whether an order moves no more joints than the best one, and explains less by no more than so."""
    own, other = best.hypothesis, change.hypothesis
    both = other.kind == own.kind == "order"
    return both and len(other.joints) <= len(own.joints) and change.fall > best.fall - margin


def _is_small_zero(arm: RigidArm, motion: ChannelMotion, fit: RigidFit, change: HypothesisTest) -> bool:
    """Whether joints move alike, so that another order does what a zero does that is slightly off, and is far rarer."""
    if change.hypothesis.kind != "order" or "q" not in change.hypothesis.channels:
        return False
    least = min(least_cost(arm, motion, joint)[0] for joint in change.hypothesis.joints)
    margin = NEARLY if _is_of_many(change) else ALIKE
    return float(fit.cost.sum()) - least > change.fall - margin


def _is_of_many(change: HypothesisTest) -> bool:
    """Whether a change is an order of more than two joints, of which there are thousands."""
    return change.hypothesis.kind == "order" and len(change.hypothesis.joints) > 2


def _screened(arm: RigidArm, few: ChannelMotion, possible: Sequence[Hypothesis]) -> list[RigidFit]:
    """The fits with each hypothesis; torques of all motions that they make in one recursion, for it costs by calls."""
    motions = [few, *(hypothesis.change(few) for hypothesis in possible)]
    moved = [k for k, motion in enumerate(motions) if k == 0 or motion.q is not few.q]
    made = arm.carried(*(np.concatenate([getattr(motions[k], x) for k in moved]) for x in ("q", "v", "a")))
    models = dict(zip(moved, np.split(made, len(moved)), strict=True))
    return fit_models([(models.get(k, models[0]), motion) for k, motion in enumerate(motions)][1:])


def _told(hypothesis: Hypothesis, moved: ChannelMotion, fit: RigidFit, better: RigidFit) -> Array:
    """Falls of the cost by joint with a hypothesis, without what only a coefficient that no arm has explains, (n,).

    Where friction outweighs the model's torque by far, only a coefficient of dozens makes that explain anything: what
    friction and rotor explain alone counts, whose signs tell as well. At a joint that others drag along, its motor all
    but idle, the model's torque is carried by friction and rotor: the motor reads a small difference of the three,
    which any change may happen to fit better; nothing counts there, nor with an angle unit that makes the model's
    torque too small by far.
    """
    low, high = PLAUSIBLE
    falls = fit.cost - better.cost
    slight = better.own_share * np.minimum(better.scale, high) < SLIGHT
    if slight.any():
        alone = fit.cost - fit_model(np.zeros_like(moved.q), moved).cost
        falls = np.where(slight, np.minimum(falls, alone), falls)
    nothing = (moved.channel != "tau") & (better.own_share > IDLE) & (better.scale < 0.5 * low)
    if hypothesis.kind == "scale":
        nothing |= slight | (better.scale > high) & (better.own_share * better.scale > STRONG_SHARE)
    return np.where(nothing, np.minimum(falls, 0.0), falls)


def _contradicts(fit: RigidFit, joints: Sequence[int]) -> bool:
    """Whether a joint that was changed should feel the model's torque strongly and does not."""
    touched = list(joints)
    if len(touched) == len(fit.scale) > 2:
        return False
    return bool(np.any((fit.own_share[touched] > 2.0 * STRONG_SHARE) & (fit.scale[touched] < 0.5 * PLAUSIBLE[0])))


def _is_sound(fit: RigidFit, touched: Collection[int]) -> bool:
    """Whether the data fit well on the joints that were corrected and on those of which the model says much."""
    judged = fit.strong & (fit.own_share > STRONG_SHARE)
    low, high = PLAUSIBLE
    plausible = bool(np.all((fit.scale > low)[judged] & (fit.scale < high)[judged]))
    fits = bool(np.all(fit.explained[judged] > FITS))
    return plausible and fits and (not touched or bool(np.median(fit.explained[list(touched)]) > FITS))


def _is_plausible(fit: RigidFit, touched: Collection[int]) -> bool:
    """Whether joints that the model explains have a coefficient that arms have."""
    low, high = PLAUSIBLE
    explains = fit.own_share * fit.scale > STRONG_SHARE
    return bool(np.all(((low < fit.scale) & (fit.scale < high) | ~explains)[list(touched)]))


def _finding(arm: RigidArm, change: HypothesisTest, fit: RigidFit, sure: bool) -> RecordingFinding:
    own = change.hypothesis
    joint = "all" if len(own.joints) == arm.n > 1 else arm.names[own.joints[0]]
    share = float(np.min(fit.explained[list(own.joints)]))
    evidence = f"{own.what}: with that the model explains {share:.0%} of the torque"
    if change.others:
        same = all(other.joints == own.joints for other in change.others)
        names = " or ".join(other.channels[0] for other in change.others) if same else "other changes"
        evidence += f"; {names} would explain as much"
    options = [each.option for each in (own, *change.others)]
    option = ", or ".join([*options[:MOST_OPTIONS], *(["another order"] if len(options) > MOST_OPTIONS else [])])
    return RecordingFinding(own.kind, own.channels[0], joint, evidence, option, sure, change.fall)
