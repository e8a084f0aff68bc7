"""Which columns of a torque channel are wrong: the hypothesis under which a sound arm most likely made the recording.

One that is certain beats the recording as it is, with effects of the arm, by far more than chance on held-out parts.
Where two corrections explain it alike, nothing is corrected, and both are said.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from armlink.recording.corrections import Corrections
from gcomp.arm.rigid_body import RigidArm
from gcomp.arrays import Array
from gcomp.estimate.linear_terms import PRICE, SIGNIFICANT
from sim_gap.checks.finding import RecordingFinding
from sim_gap.checks.hypotheses import Hypothesis, exchangeable, exchanged, hypotheses, put_in_order, zero_offsets
from sim_gap.checks.sound_arm import CERTAIN_COST, ChannelMotion, likelihood, quick_costs

SCREENING_ROWS = 150
"""Rows that are enough to see that a hypothesis is wrong."""
MOST_CANDIDATES = 8
"""Hypotheses that are looked at closely, and orders from which exchanges go on."""
ORDER_ROWS = 30
"""Rows on which orders are compared."""
DECISIVE_FALL, MOST_OF_A_READING = 1.5 * PRICE, 2.0 * PRICE
"""Fall from which one correction is likelier than another, odds of 400; most that one reading counts for."""
MOST_OPTIONS = 2
"""Most options that are spelt out."""


@dataclass(frozen=True, eq=False)
class HypothesisTest:
    """A hypothesis beside the recording as it is."""

    hypothesis: Hypothesis
    falls: Array
    """Fall of the cost of each reading in each held-out part, less its share of the price, (n, F)."""
    least: float
    """Fall that makes it certain."""

    @property
    def fall(self) -> float:
        return float(self.falls.sum())

    @property
    def is_certain(self) -> bool:
        """Whether nothing but the fault can be the reason; what all joints have in common must show without the joint
        that shows it most."""
        common = len(self.falls) > 1 and self.hypothesis.kind in ("clock", "effort_source")
        return self.fall > self.least and _exceeds_chance(self.falls) and (not common or _exceeds_chance(self._others))

    @property
    def is_likely(self) -> bool:
        """Whether a fault that all joints have in common, as no effect of an arm has, is likelier than none."""
        common = 1 < len(self.falls) == len(self.hypothesis.joints)
        return common and self.fall > DECISIVE_FALL and _exceeds_chance(self.falls) and _exceeds_chance(self._others)

    @property
    def _others(self) -> Array:
        """The falls without those of the joint that shows the fault most."""
        return np.delete(self.falls, self.falls.sum(1).argmax(), axis=0)


def _exceeds_chance(falls: Array) -> bool:
    """Whether the sum of falls in held-out parts (…, F) is more than parts that differ by chance make."""
    by_part = falls.sum(0)
    return bool(by_part.sum() > SIGNIFICANT * by_part.std(ddof=1) * np.sqrt(len(by_part)))


def _is_likelier(one: HypothesisTest, other: HypothesisTest) -> bool:
    """Whether one correction is likelier than another by all readings, each of which may be one that no model of a
    sound arm explains."""
    by_reading = (one.falls - other.falls).sum(1)
    return float(np.clip(by_reading, -MOST_OF_A_READING, MOST_OF_A_READING).sum()) > DECISIVE_FALL


def find_wrong_columns(
    arm: RigidArm, motion: ChannelMotion, stated: Corrections, follows: Sequence[str], known: Collection[str] = ()
) -> RecordingFinding | None:
    """The one thing that is most likely wrong with a torque channel and its motion, if anything certainly is.

    `follows` are the channels (of `dq`, `q_cmd`) whose columns agree with the positions' as they are recorded, so that
    what is wrong with a position is wrong with theirs. `known` are options that corrected other recordings of the
    set-up, and need not be chosen again. A finding that is not `corrected` names an unknown number, more corrections
    than one that may be right, or one that is likely but not certain.
    """
    as_it_is = likelihood(arm, motion)
    motion = replace(motion, idle=as_it_is.idle)  # no reading becomes a dead one by a correction
    possible = list(hypotheses(arm, motion, stated, follows))
    if not (stated.order or stated.joints):
        possible += _likely_orders(arm, motion, follows)
    falls = _quick_falls(arm, motion, possible)
    likely = [*(each for each in possible if each.option in known), *_likeliest(possible, falls)]
    offsets = list(zero_offsets(arm))
    likely.append(offsets[int(_quick_falls(arm, motion, offsets).argmax())])
    tests = [_test(arm, motion, as_it_is.costs, each, each.option in known) for each in dict.fromkeys(likely)]
    certain = [test for test in tests if test.is_certain]
    tests = certain or [test for test in tests if test.is_likely]
    if not tests:
        return None
    most = max(test.fall for test in tests)
    best = min((test for test in tests if np.isclose(test.fall, most)), key=lambda test: len(test.hypothesis.joints))
    rivals = [test for test in tests if not (np.allclose(best.falls, test.falls) or _is_likelier(best, test))]
    if any(test.hypothesis.of_arm for test in (best, *rivals)):
        return None
    return _finding(arm, [best, *rivals], bool(certain))


def _quick_falls(arm: RigidArm, motion: ChannelMotion, possible: Sequence[Hypothesis]) -> Array:
    """Fall of the cost by each hypothesis, less the price, on some of the rows, (M,)."""
    changed = [motion, *(hypothesis.change(motion) for hypothesis in possible)]
    moved = [k for k, each in enumerate(changed) if k == 0 or each.q is not motion.q or each.rubs != motion.rubs]
    motions = [each.thinned(SCREENING_ROWS) for each in changed]
    made = arm.carried(*(np.concatenate([getattr(motions[k], x) for k in moved]) for x in ("q", "v", "a")))
    models = dict(zip(moved, np.split(made, len(moved)), strict=True))
    costs = quick_costs(arm, np.array([models.get(k, models[0]) for k in range(len(motions))]), motions, moved)
    return np.asarray(costs[0] - costs[1:] - PRICE * np.array([hypothesis.choices for hypothesis in possible]))


def _likeliest(possible: Sequence[Hypothesis], falls: Array) -> list[Hypothesis]:
    """The hypotheses that explain most by a joint's own effects, of those with a free number the best number."""
    best: dict[tuple[object, ...], int] = {}
    for k in np.argsort(-falls).tolist():
        each = possible[k]
        own = each.option if each.choices == 1 or (each.kind == "order" and each.corrects) else ""
        if falls[k] > 0.0:
            best.setdefault((each.kind, each.channels, each.joints, each.corrects, own), k)
    return [possible[k] for k in [*best.values()][:MOST_CANDIDATES]]


def _test(arm: RigidArm, motion: ChannelMotion, before: Array, hypothesis: Hypothesis, known: bool) -> HypothesisTest:
    changed = hypothesis.change(motion)
    gone = np.isnan(changed.reading) & ~np.isnan(motion.reading)
    if gone.any():  # both are judged on the same rows
        before = likelihood(arm, replace(motion, reading=np.where(gone, np.nan, motion.reading))).costs
    after = likelihood(arm, changed).costs
    if hypothesis.readings:
        after = after[np.argsort(hypothesis.readings)]
    falls = before - after
    price = 0.0 if known else PRICE * hypothesis.choices
    return HypothesisTest(hypothesis, falls - price / before.size, 0.0 if known else CERTAIN_COST)


def _likely_orders(arm: RigidArm, motion: ChannelMotion, follows: Sequence[str]) -> list[Hypothesis]:
    """Orders of more than two columns, of positions, of torques and of both: exchange after exchange from those that
    explain most after the one before; none where no exchange explains more than the order as it is recorded."""
    found, few = list[Hypothesis](), motion.thinned(ORDER_ROWS)
    for channels, joints in exchangeable(arm, motion, follows):
        orders = [tuple(range(arm.n))]
        for _ in joints[1:MOST_CANDIDATES]:
            pairs = dict.fromkeys(exchanged(order, pair) for order in orders for pair in combinations(joints, 2))
            trials = [put_in_order(arm, order, channels, motion.channel) for order in pairs]
            falls = _quick_falls(arm, few, trials)
            if falls.max() <= 0.0:
                break
            best = np.argsort(-falls)[:MOST_CANDIDATES].tolist()
            orders, found = [[*pairs][k] for k in best], [*found, *(trials[k] for k in best)]
    return [each for each in found if len(each.joints) > 2]


def _finding(arm: RigidArm, tests: Sequence[HypothesisTest], is_certain: bool) -> RecordingFinding:
    """The finding of the first of tests, beside others that explain the recording as well."""
    own = tests[0].hypothesis
    joint = "all" if len(own.joints) == arm.n > 1 else arm.names[own.joints[0]]
    options = list(dict.fromkeys(each.hypothesis.option for each in tests))
    shown, more = options[:MOST_OPTIONS], ["another correction"] if len(options) > MOST_OPTIONS else []
    evidence = own.what if is_certain else f"perhaps {own.what}"
    evidence += "; other corrections would explain the recording as well" if len(options) > 1 else ""
    corrected = is_certain and own.corrects and len(options) == 1
    return RecordingFinding(own.kind, own.channels[0], joint, evidence, ", or ".join([*shown, *more]), corrected)
