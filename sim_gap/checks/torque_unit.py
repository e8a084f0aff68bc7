"""Unit of a torque channel, or of one joint in it, and joints whose torque is absent from their column."""

import numpy as np
from numpy.typing import NDArray

from armlink.recording.corrections import Corrections
from gcomp.arrays import Array
from sim_gap.checks.finding import RecordingFinding
from sim_gap.checks.mounting import find_load
from sim_gap.checks.rigid_fit import (
    MOVING_SHARE,
    STRONG_CORRELATION,
    TURNING,
    ChannelMotion,
    RigidFit,
    fit_rigid,
)
from sim_gap.model.rigid_body import RigidArm

SCALE = 0.42, 2.4
"""Median coefficient of the model's torque, weighted by that torque, outside which a channel is in another unit; with
loads and wrong torque constants it stays between 0.65 and 1.9 on real arms."""
TELLING = 0.3
"""Share of the model's torque (root sum of squares) that the joints must have which tell its unit: a slim wrist alone,
on which something else pulls, tells nothing of the others."""
ABSENT, HELD = 3.0, 0.2
"""The model's torque is absent from a joint's reading if its own part is this multiple of all that is read, and comes
back with a coefficient below this; on recordings of real arms the first stays below 1.2."""
STUCK = 1e6
"""From this multiple on the reading does not change at all: it is stuck, which the diagnosis says by itself."""
JOINTS = 0.2, 2.4
"""Coefficient of a joint that follows the model, the load at the tip in it, outside which it has a unit of its own; on
real arms and parts of their recordings, and on simulated arms, it stays between 0.33 and 1.6."""
LITTLE, EXPLAINED = 0.5, 0.9
"""Correlation with the model's torque, beside friction and rotor, of a joint that follows it although friction hides
it, where that torque is more than all that is read, and share of the reading that they explain together."""
ALONE = 0.15
"""Share of the model's torque in a reading (standard deviations) below which it is friction alone; on real and
simulated arms such a joint reads at most 0.65 of what those nearer the base do, the first joint left aside."""
OUTGROWN = 5.0
"""From this multiple of those on it is in another unit: milliamperes are some tens or hundreds of newton metres, and
the last joint of a leg, which rubs most, reads three times what the others do."""
SLIM = 0.03
"""Least share of the largest model torque (standard deviations) that a joint's must have for its coefficient to tell a
unit: at a slim wrist a tool, a hose or a spring may be more."""


def find_scale(arm: RigidArm, fit: RigidFit, motion: ChannelMotion, stated: Corrections) -> list[RecordingFinding]:
    """A channel in another unit: the model's torque comes back with a coefficient that no arm has.

    One strong joint alone may carry a load: others that follow the model are asked too, a unit is that of all.
    """
    strong = fit.strong & (fit.correlation > 0.0)
    if strong.sum() == 1:
        strong |= fit.correlation > STRONG_CORRELATION
    own = fit.own_share * fit.spread
    few = np.linalg.norm(own[strong]) < TELLING * np.linalg.norm(own)
    if stated.states("units", f"{motion.channel}_1") or not strong.any() or few:
        return []
    scale = _weighted_median(fit.scale[strong], (fit.own_share * fit.spread)[strong])
    if SCALE[0] < scale < SCALE[1]:
        return []
    joints = ", ".join(f"{arm.names[j]} {fit.scale[j]:.3g}" for j in np.flatnonzero(strong))
    evidence = f"is the model's torque times a factor ({joints}): is it in amperes, or another unit?"
    option = f"--units {motion.channel}=A:K (N·m/A at the joint, or one each: K1;K2;…), or {motion.channel}=N·m"
    return [RecordingFinding("scale", motion.channel, "all", evidence, option, False)]


def find_joint_scale(arm: RigidArm, motion: ChannelMotion, stated: Corrections) -> list[RecordingFinding]:
    """Joints that follow the model's torque in another unit than the others: one driver gives amperes, say.

    A load at the tip counts many times at a slim wrist. It is fitted to all readings, and to those of the other joints
    alone, for it may follow a wrong one; a spring is tried beside it. A joint is asked about if none explains it, and
    as many others are in the model's unit.
    """
    loaded = find_load(arm, motion)
    fit = fit_rigid(loaded, motion)
    found = []
    follows = _follows(fit)
    odd = (fit.scale < JOINTS[0]) | (fit.scale > JOINTS[1])
    for j in np.flatnonzero(follows & odd).tolist():
        column = f"{motion.channel}_{j + 1}"
        others = find_load(arm, motion, without=j)
        alone = fit_rigid(others, motion)
        own = alone.own_share * alone.spread
        scales = np.array([each.scale[j] for each in (fit, alone, fit_rigid(others, motion, springs=True))])
        apart = np.all(scales < JOINTS[0]) or np.all(scales > JOINTS[1])
        tells = _follows(alone)[j] and own[j] > SLIM * own.max()
        if stated.states("units", column) or not apart or not tells:
            continue
        evidence = (
            f"is {alone.scale[j]:.3g} times the model's torque, unlike the other joints: is it in amperes, or another "
            "unit?"
        )
        option = f"--units {column}=A:K (N·m/A at the joint), or {column}=N·m if it is right"
        found.append(RecordingFinding("scale", motion.channel, arm.names[j], evidence, option, False))
    return found if len(found) <= np.count_nonzero(follows & ~odd) else []


def _follows(fit: RigidFit) -> NDArray[np.bool_]:
    """Whether the model's torque is in each joint's reading, (n,)."""
    hidden = (fit.correlation > LITTLE) & (fit.own_share > 1.0) & (fit.explained > EXPLAINED)
    return (fit.correlation > STRONG_CORRELATION) | hidden


def find_outgrown(
    arm: RigidArm, mounted: RigidArm, motion: ChannelMotion, stated: Corrections
) -> list[RecordingFinding]:
    """Joints with friction alone that read more than any joint between them and the base that moves, too."""
    spread, model = motion.reading.std(0), mounted.carried(motion.q, motion.v, motion.a).std(0)
    turns = np.mean(np.abs(motion.v) > TURNING, axis=0) > MOVING_SHARE
    found = []
    for j in range(1, arm.n):
        if not turns[:j].any():  # what they read at rest says nothing of their unit
            continue
        column, largest = f"{motion.channel}_{j + 1}", float(max(spread[:j][turns[:j]].max(), model.max()))
        if model[j] < ALONE * spread[j] and spread[j] > OUTGROWN * largest and not stated.states("units", column):
            evidence = (
                f"varies by {spread[j]:.3g} N·m, of which the model's torque is {model[j] / spread[j]:.0%}; no joint "
                f"nearer the base varies by more than {largest:.3g} N·m: is it in milliamperes, or another unit?"
            )
            option = f"--units {column}=A:K (N·m/A at the joint), or {column}=N·m if it is right"
            found.append(RecordingFinding("scale", motion.channel, arm.names[j], evidence, option, False))
    return found


def find_absent(arm: RigidArm, fit: RigidFit, motion: ChannelMotion, stated: Corrections) -> list[RecordingFinding]:
    """Joints whose link-side sensor should read several times all that it does: the column of another joint.

    A column that varies with another joint's motion may fit as well as the joint's own, by a spring or a rotor that no
    arm has, so that nothing is gained by an exchange. A motor is not judged: its gear's friction may hold the load.
    """
    if motion.channel != "tau" or stated.states("units", f"{motion.channel}_1") or stated.order or stated.joints:
        return []
    found = []
    read = (fit.own_share > ABSENT) & (fit.own_share < STUCK)
    for j in np.flatnonzero(read & (fit.scale < HELD)).tolist():
        evidence = (
            f"varies by {fit.spread[j]:.2g} N·m; the model's torque for this joint varies {fit.own_share[j]:.0f} times "
            "more and does not show in it: is it another joint's column?"
        )
        option = f"--map {motion.channel}_{j + 1}=COLUMN, or --units {motion.channel}=N·m if it is right"
        found.append(RecordingFinding("order", motion.channel, arm.names[j], evidence, option, False))
    return found


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
