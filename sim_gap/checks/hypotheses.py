"""Ways in which the order, a sign, a zero or the angle unit of a recording's columns may be wrong."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from armlink.recording.corrections import Corrections
from gcomp.arrays import Array
from sim_gap.checks.finding import Kind
from sim_gap.checks.rigid_fit import ChannelMotion
from sim_gap.model.rigid_body import RigidArm

TURN = math.pi / 180.0


@dataclass(frozen=True)
class Hypothesis:
    """One way in which the data may be wrong."""

    kind: Kind
    channels: tuple[str, ...]
    """Prefixes of the columns that change, the telling one first."""
    joints: tuple[int, ...]
    what: str
    option: str
    change: Callable[[ChannelMotion], ChannelMotion]


def hypotheses(
    arm: RigidArm, motion: ChannelMotion, stated: Corrections, follows: Sequence[str]
) -> Iterator[Hypothesis]:
    """Every way in which one column, or all of a channel, may be wrong, less those that the user has settled."""
    channel = motion.channel

    def settled(kind: str, channel: str, joints: Sequence[int]) -> bool:
        return any(stated.states(kind, f"{channel}_{j + 1}") for j in joints)

    def option(kind: str, channels: Sequence[str], value: str, joint: int | None = None) -> str:
        place = "" if joint is None else f"_{joint + 1}"
        return f"--{kind} " + ",".join(f"{name}{place}={value}" for name in channels)

    positions, every, opposite = ("q", *follows), tuple(range(arm.n)), "has the opposite sign"
    if not settled("sign", channel, every):
        yield Hypothesis("sign", (channel,), every, opposite, option("sign", [channel], "-1"), _turned(every, True))
    far = np.median(np.abs(motion.q).max(axis=0)) > math.pi  # as angles in degrees are, and those of one joint are not
    if far and not settled("units", "q", every):
        yield Hypothesis("scale", ("q",), every, "is in degrees", option("units", positions, "deg"), _degrees)
    for j in range(arm.n):
        if not settled("sign", channel, (j,)):
            text = option("sign", [channel], "-1", j)
            yield Hypothesis("sign", (channel,), (j,), opposite, text, _turned((j,), True))
        if not settled("sign", "q", (j,)):
            yield Hypothesis("sign", ("q",), (j,), opposite, option("sign", positions, "-1", j), _turned((j,), False))
        if not settled("zero", "q", (j,)):
            for angle in (0.5 * math.pi, -0.5 * math.pi, math.pi):
                moved = [name for name in positions if name != "dq"]
                text = option("zero", moved, f"{angle:.5f}", j)
                yield Hypothesis("zero", ("q",), (j,), f"has its zero off by {angle:+.2f} rad", text, _moved(j, angle))
    if stated.order or stated.joints:
        return
    orders = [_exchanged(arm.n, i, k) for i, k in combinations(range(arm.n), 2)]
    if arm.n > 3:
        orders.append(tuple(reversed(range(arm.n))))
    for order in orders:
        for channels in ((*positions, channel), positions, (channel,)):
            yield put_in_order(arm, order, channels, channel)


def _exchanged(n: int, i: int, k: int) -> tuple[int, ...]:
    order = list(range(n))
    order[i], order[k] = k, i
    return tuple(order)


def put_in_order(arm: RigidArm, order: tuple[int, ...], channels: Sequence[str], torque: str) -> Hypothesis:
    """Columns of some channels in another order."""
    touched = tuple(j for j, other in enumerate(order) if j != other)
    names = ", ".join(arm.names[j] for j in touched)
    what = f"is in another order ({names} hold {', '.join(arm.names[order[j]] for j in touched)})"
    option = "--map " + ",".join(f"{name}_{j + 1}={name}_{order[j] + 1}" for name in channels for j in touched)
    values = [*(("q", "v", "a") if "q" in channels else ()), *(("reading",) if torque in channels else ())]
    return Hypothesis("order", tuple(channels), touched, what, option, permute(order, values))


def _turned(joints: tuple[int, ...], torque: bool) -> Callable[[ChannelMotion], ChannelMotion]:
    """Change of sign of the torques, or of the positions, of some joints."""

    def change(motion: ChannelMotion) -> ChannelMotion:
        sign = np.ones(motion.q.shape[1])
        sign[list(joints)] = -1.0
        if torque:
            return replace(motion, reading=motion.reading * sign)
        return replace(motion, q=motion.q * sign, v=motion.v * sign, a=motion.a * sign)

    return change


def _moved(joint: int, angle: float) -> Callable[[ChannelMotion], ChannelMotion]:
    def change(motion: ChannelMotion) -> ChannelMotion:
        q = motion.q.copy()
        q[:, joint] += angle
        return replace(motion, q=q)

    return change


def _degrees(motion: ChannelMotion) -> ChannelMotion:
    return replace(motion, q=motion.q * TURN, v=motion.v * TURN, a=motion.a * TURN)


def permute(order: Sequence[int], names: Sequence[str]) -> Callable[[ChannelMotion], ChannelMotion]:
    """Columns of some fields of a motion in another order."""

    def change(motion: ChannelMotion) -> ChannelMotion:
        values: dict[str, Array] = {name: getattr(motion, name)[:, list(order)] for name in names}
        return replace(motion, **values)  # type: ignore[arg-type]

    return change
