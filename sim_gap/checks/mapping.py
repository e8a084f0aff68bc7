"""Order, sign, zero and angle unit of the columns, judged by the model: which change makes the data fit it?

Each hypothesis changes the data in one way. It is accepted if what the model leaves unexplained falls by far more than
wrong masses, friction or a tilted base could explain, and the data fit well with it. On recordings of sound arms no
hypothesis comes near; a change that the model cannot see (the zero of a vertical first joint) makes no difference to
the diagnosis either.
"""

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from armlink.recording.corrections import Corrections
from gcomp.arrays import Array
from sim_gap.checks.finding import Finding, Kind
from sim_gap.checks.rigid_fit import (
    STRONG_SHARE,
    Motion,
    RigidFit,
    as_loaded,
    as_mounted,
    changed,
    few_rows,
    fit_model,
    fit_models,
    fit_rigid,
)
from sim_gap.model.rigid_body import RigidArm

SURE = 0.3
"""Fall of the summed cost from which a hypothesis is accepted; a wrong one stays below 0.15 on sound recordings."""
DOUBTED = 0.4
"""Fall from which one that makes a joint much worse, or contradicts the model, is asked about; on sound recordings no
hypothesis at all reaches 0.25."""
SCREENED = 0.3
"""Share of that fall that a hypothesis must reach on few rows."""
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
TURN = math.pi / 180.0


@dataclass(frozen=True)
class Hypothesis:
    """One way in which the data may be wrong."""

    kind: Kind
    channel: str
    joints: tuple[int, ...]
    what: str
    option: str
    change: Callable[[Motion], Motion]


def find_mapping(
    arm: RigidArm, motion: Motion, stated: Corrections, follows: Sequence[str] = (), mounted: RigidArm | None = None
) -> list[Finding]:
    """Findings on order, sign, zero and angle unit of a motion, one after the other.

    `mounted` is the arm `as_mounted` in this motion, if it is known. `follows` are the channels (of `dq`, `q_cmd`)
    whose columns agree with the positions' as they are recorded, so that what is wrong with a position is wrong with
    theirs. All findings are corrected, or none is. A slight fall counts only if every joint concerned is explained
    then: a model that was fitted to another motion leaves some of them to chance.
    """
    fit = _as_an_arm(mounted or as_mounted(arm, motion), motion)
    taken: list[tuple[Hypothesis, float]] = []
    doubted = False
    while not doubted and len(taken) < 2 * arm.n:
        best = _best(arm, motion, fit, list(hypotheses(arm, motion.channel, stated, follows)))
        if best is None:
            break
        hypothesis, fit, fall, doubted = best
        motion = hypothesis.change(motion)
        taken.append((hypothesis, fall))
    touched = {joint for hypothesis, _ in taken for joint in hypothesis.joints}
    sure = not doubted and _is_sound(fit, touched)
    slight = sum(fall for _, fall in taken) < DOUBTED
    if slight and not (sure and np.all(fit.explained[list(touched)] > FITS)):
        return []
    return [_finding(arm, hypothesis, fit, fall, sure) for hypothesis, fall in taken]


def _as_an_arm(mounted: RigidArm, motion: Motion) -> RigidFit:
    """The fit as it stands, gravity, a tool and springs included where they explain it: effects of the arm."""
    model = as_loaded(mounted, motion).carried(motion.q, motion.v, motion.a)
    plain, sprung = fit_model(model, motion), fit_model(model, motion, springs=True)
    beside = (sprung.scale > PLAUSIBLE[0]) | (sprung.own_share < STRONG_SHARE)  # not in place of gravity
    return replace(plain, explained=np.where(beside & (sprung.explained > SPRUNG), sprung.explained, plain.explained))


def _best(
    arm: RigidArm, motion: Motion, fit: RigidFit, possible: Sequence[Hypothesis]
) -> tuple[Hypothesis, RigidFit, float, bool] | None:
    """The hypothesis that lowers the cost most, if by enough, and whether it is doubted; a doubted one comes last."""
    best, most = None, {False: SURE, True: DOUBTED}
    for hypothesis, screened in zip(possible, _screened(arm, few_rows(motion), possible), strict=True):
        if float((fit.cost - screened.cost).sum()) < SCREENED * SURE:
            continue
        better = fit_rigid(arm, hypothesis.change(motion))
        fall = float(_told(hypothesis, motion.channel, better, fit.cost - better.cost).sum())
        worse = float(np.max(better.cost - fit.cost))
        doubted = worse >= MOST_WORSE * fall or _contradicts(better, hypothesis.joints)
        if fall > most[doubted]:
            most[doubted] = fall
            if best is None or best[3] or not doubted:
                best = (hypothesis, better, fall, doubted)
    return best


def _screened(arm: RigidArm, few: Motion, possible: Sequence[Hypothesis]) -> list[RigidFit]:
    """The fits with each hypothesis; torques of all motions that they make in one recursion, for it costs by calls."""
    motions = [few, *(hypothesis.change(few) for hypothesis in possible)]
    moved = [k for k, motion in enumerate(motions) if k == 0 or motion.q is not few.q]
    made = arm.carried(*(np.concatenate([getattr(motions[k], x) for k in moved]) for x in ("q", "v", "a")))
    models = dict(zip(moved, np.split(made, len(moved)), strict=True))
    return fit_models([(models.get(k, models[0]), motion) for k, motion in enumerate(motions)][1:])


def _told(hypothesis: Hypothesis, channel: str, fit: RigidFit, falls: Array) -> Array:
    """Falls of the cost by joint with a hypothesis, without those that the model has no part in, (n,).

    At a joint that others drag along, its motor all but idle, the model's torque is carried by friction and rotor: the
    motor reads a small difference of the three, which any change may happen to fit better, with a coefficient of the
    model that no arm has. So it is with an angle unit that makes the model's torque too small by far, and where
    friction outweighs the model's torque by far: only a coefficient of dozens makes that explain anything.
    """
    low, high = PLAUSIBLE
    nothing = (channel != "tau") & (fit.own_share > IDLE) & (fit.scale < 0.5 * low)
    nothing |= fit.own_share * np.minimum(fit.scale, high) < SLIGHT
    if hypothesis.kind == "scale":
        nothing |= (fit.scale > high) & (fit.own_share * fit.scale > STRONG_SHARE)
    return np.where(nothing, np.minimum(falls, 0.0), falls)


def _contradicts(fit: RigidFit, joints: Sequence[int]) -> bool:
    """Whether a joint that was changed should feel the model's torque strongly and does not."""
    touched = list(joints)
    if len(touched) == len(fit.scale) > 2:
        return False
    return bool(np.any((fit.own_share[touched] > 2.0 * STRONG_SHARE) & (fit.scale[touched] < 0.5 * PLAUSIBLE[0])))


def hypotheses(arm: RigidArm, channel: str, stated: Corrections, follows: Sequence[str]) -> Iterator[Hypothesis]:
    """Every way in which one column, or all of a channel, may be wrong, less those that the user has settled."""

    def settled(kind: str, channel: str, joints: Sequence[int]) -> bool:
        return any(stated.states(kind, f"{channel}_{j + 1}") for j in joints)

    def option(kind: str, channels: Sequence[str], value: str, joint: int | None = None) -> str:
        place = "" if joint is None else f"_{joint + 1}"
        return f"--{kind} " + ",".join(f"{name}{place}={value}" for name in channels)

    positions, every, opposite = ("q", *follows), tuple(range(arm.n)), "has the opposite sign"
    if not settled("sign", channel, every):
        yield Hypothesis("sign", channel, every, opposite, option("sign", [channel], "-1"), _turned(every, True))
    if not settled("units", "q", every):
        yield Hypothesis("scale", "q", every, "is in degrees", option("units", positions, "deg"), _degrees)
    for j in range(arm.n):
        if not settled("sign", channel, (j,)):
            text = option("sign", [channel], "-1", j)
            yield Hypothesis("sign", channel, (j,), opposite, text, _turned((j,), True))
        if not settled("sign", "q", (j,)):
            yield Hypothesis("sign", "q", (j,), opposite, option("sign", positions, "-1", j), _turned((j,), False))
        if not settled("zero", "q", (j,)):
            for angle in (0.5 * math.pi, -0.5 * math.pi, math.pi):
                moved = [name for name in positions if name != "dq"]
                text = option("zero", moved, f"{angle:.5f}", j)
                yield Hypothesis("zero", "q", (j,), f"has its zero off by {angle:+.2f} rad", text, _moved(j, angle))
    if stated.columns or stated.joints:
        return
    orders = [_exchanged(arm.n, i, k) for i, k in combinations(range(arm.n), 2)]
    if arm.n > 3:
        orders.append(tuple(reversed(range(arm.n))))
    for order in orders:
        for channels in ((*positions, channel), positions, (channel,)):
            yield _ordered(arm, order, channels, channel)


def _exchanged(n: int, i: int, k: int) -> tuple[int, ...]:
    order = list(range(n))
    order[i], order[k] = k, i
    return tuple(order)


def _ordered(arm: RigidArm, order: tuple[int, ...], channels: Sequence[str], torque: str) -> Hypothesis:
    """Columns of some channels in another order."""
    touched = tuple(j for j, other in enumerate(order) if j != other)
    names = ", ".join(arm.names[j] for j in touched)
    what = f"is in another order ({names} hold {', '.join(arm.names[order[j]] for j in touched)})"
    option = "--map " + ",".join(f"{name}_{j + 1}={name}_{order[j] + 1}" for name in channels for j in touched)
    values = [*(("q", "v", "a") if "q" in channels else ()), *(("reading",) if torque in channels else ())]
    return Hypothesis("order", channels[0], touched, what, option, _permuted(order, values))


def _is_sound(fit: RigidFit, touched: Collection[int]) -> bool:
    """Whether the data fit well on the joints that were corrected and on those of which the model says much."""
    judged = fit.strong & (fit.own_share > STRONG_SHARE)
    low, high = PLAUSIBLE
    plausible = bool(np.all((fit.scale > low)[judged] & (fit.scale < high)[judged]))
    fits = bool(np.all(fit.explained[judged] > FITS))
    return plausible and fits and (not touched or bool(np.median(fit.explained[list(touched)]) > FITS))


def _finding(arm: RigidArm, hypothesis: Hypothesis, fit: RigidFit, fall: float, sure: bool) -> Finding:
    joints = hypothesis.joints
    joint = "all" if len(joints) == arm.n > 1 else arm.names[joints[0]]
    share = float(np.min(fit.explained[list(joints)]))
    evidence = f"{hypothesis.what}: then the model explains {share:.0%} (logarithm of what is left falls by {fall:.1f})"
    return Finding(hypothesis.kind, hypothesis.channel, joint, evidence, hypothesis.option, sure, fall)


def _turned(joints: tuple[int, ...], torque: bool) -> Callable[[Motion], Motion]:
    """Change of sign of the torques, or of the positions, of some joints."""

    def change(motion: Motion) -> Motion:
        sign = np.ones(motion.q.shape[1])
        sign[list(joints)] = -1.0
        if torque:
            return changed(motion, reading=motion.reading * sign)
        return changed(motion, q=motion.q * sign, v=motion.v * sign, a=motion.a * sign)

    return change


def _moved(joint: int, angle: float) -> Callable[[Motion], Motion]:
    def change(motion: Motion) -> Motion:
        q = motion.q.copy()
        q[:, joint] += angle
        return changed(motion, q=q)

    return change


def _degrees(motion: Motion) -> Motion:
    return changed(motion, q=motion.q * TURN, v=motion.v * TURN, a=motion.a * TURN)


def _permuted(order: tuple[int, ...], names: Sequence[str]) -> Callable[[Motion], Motion]:
    def change(motion: Motion) -> Motion:
        values: dict[str, Array] = {name: getattr(motion, name)[:, list(order)] for name in names}
        return changed(motion, **values)

    return change
