"""Ways in which the columns of a recording may be wrong: order, sign, zero, unit, clock, and what the torque is."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, combinations, product

import numpy as np

from armlink.recording.corrections import WITHOUT_GRAVITY, Corrections
from gcomp.arm.rigid_body import RigidArm
from gcomp.arrays import Array
from gcomp.estimate.linear_terms import REWEIGHINGS
from sim_gap.checks.finding import Kind
from sim_gap.checks.sound_arm import ERROR_STD, ChannelMotion

LONGEST_DELAY, DELAY_STEP = 1.5, 0.02
"""Longest delay that is looked for, and its step [s]."""
DRIVE_DELAYS = {"tau": (-0.03, 0.06), "tau_motor": (-0.03, 0.03), "tau_cmd": (-0.12, 0.12)}
"""Delays of a channel between which they are an effect of drive or sensor, which the diagnosis finds by itself [s]:
sensors read late, drives follow a command late, and positions are some milliseconds old."""
UNIT_FACTORS = np.geomspace(1e-3, 2e3, 32)
"""Numbers that may be recorded of one newton metre: a torque constant with a gear or without, mA."""
ORDER_CHANGES = np.linspace(0.1, 0.9, 5)
"""Shares of the rows after which the order is tried to change."""
POSITION_CHOICES = 4
"""Choices of a change of the positions: whoever watched the arm saw them, and so they are rarer than wrong torques."""
STATEMENTS = {"sign": "sign", "unsigned": "sign", "zero": "zero", "scale": "units"}
"""Statement of the user that settles each kind."""
LEAST_SIGN_SHARE = 0.1
"""Least share of the rows on either side of zero from which a torque changes its sign."""


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
    choices: int = 1
    """Number of things that are chosen in it, each as rare as an effect of the library."""
    corrects: bool = True
    """Whether the option can be carried out as it stands."""
    readings: tuple[int, ...] = ()
    """Which reading each joint has then, if not its own."""
    of_arm: bool = False
    """Whether this is an effect of the arm, which the diagnosis finds by itself."""


def hypotheses(
    arm: RigidArm, motion: ChannelMotion, stated: Corrections, follows: Sequence[str]
) -> Iterator[Hypothesis]:
    """Every way in which one column, or all of a channel, may be wrong, less those that the user has settled."""
    of_columns = chain(_units(arm, motion), _signs(arm, motion, follows), _zeros(arm, motion, follows))
    for each in of_columns:
        columns = (f"{each.channels[0]}_{j + 1}" for j in each.joints)
        if not any(stated.states(STATEMENTS[each.kind], column) for column in columns):
            yield each
    yield from _sources(arm, motion, stated)
    yield from _delays(arm, motion, stated)
    if not (stated.order or stated.joints):
        yield from _orders(arm, motion, follows)


def _option(kind: str, channels: Sequence[str], value: str, joint: int | None = None) -> str:
    place = "" if joint is None else f"_{joint + 1}"
    return f"--{kind} " + ",".join(f"{name}{place}={value}" for name in channels)


def _signs(arm: RigidArm, motion: ChannelMotion, follows: Sequence[str]) -> Iterator[Hypothesis]:
    channel, every, opposite = motion.channel, tuple(range(arm.n)), "the sign is opposite"
    positions = ("q", *follows)
    for joints in [every, *((j,) for j in every if arm.n > 1)]:
        own = None if len(joints) == arm.n else joints[0]
        text, factor = _option("sign", [channel], "-1", own), np.where(np.isin(every, joints), -1.0, 1.0)
        yield Hypothesis("sign", (channel,), joints, opposite, text, partial(_torques, factor=factor))
        if len(joints) == 1:
            text, change = _option("sign", positions, "-1", joints[0]), partial(_positions, factor=factor)
            yield Hypothesis("sign", ("q",), joints, opposite, text, change, POSITION_CHOICES)
    model = arm.carried(motion.q, motion.v, motion.a)
    for j in every:
        y, turns = motion.reading[:, j], np.mean(model[:, j] > 0.0)
        one_sided = min(np.mean(y > 0.02 * y.std()), np.mean(y < -0.02 * y.std())) < 0.005
        if one_sided and LEAST_SIGN_SHARE < turns < 1.0 - LEAST_SIGN_SHARE:
            option = f"record signed torque, or give --sign {channel}_{j + 1}=1 if this is right"
            what = "the torque never changes its sign, but the torque of the model does"
            change = partial(_signed, arm=arm, joint=j)
            yield Hypothesis("unsigned", (channel,), (j,), what, option, change, corrects=False)


def _zeros(arm: RigidArm, motion: ChannelMotion, follows: Sequence[str]) -> Iterator[Hypothesis]:
    positions, every = ("q", *follows), tuple(range(arm.n))
    largest = np.abs(motion.q).max(axis=0)
    far = [j for j in every if largest[j] > math.pi]
    for joints in [*[every] * bool(np.median(largest) > math.pi), *((j,) for j in far if arm.n > 1)]:
        one, what = (None, "positions are") if joints is every else (joints[0], "position is")
        change = partial(_positions, factor=np.where(np.isin(every, joints), math.radians(1.0), 1.0))
        choices = 1 if joints is every else POSITION_CHOICES  # a single joint in another unit is rarer
        text = _option("units", positions, "deg", one)
        yield Hypothesis("scale", ("q",), joints, f"the {what} in degrees", text, change, choices)
    for j, angle in product(every, (0.5 * math.pi, -0.5 * math.pi, math.pi)):
        text = _option("zero", [name for name in positions if name != "dq"], f"{angle:.5f}", j)
        what, change = f"the zero is off by {angle:+.2f} rad", partial(_positions, zero=angle * np.eye(arm.n)[j])
        yield Hypothesis("zero", ("q",), (j,), what, text, change, POSITION_CHOICES)


def zero_offsets(arm: RigidArm) -> Iterator[Hypothesis]:
    """Zeros of the positions that are off as far as those of sound arms are."""
    for j, angle in product(range(arm.n), np.linspace(-ERROR_STD, ERROR_STD, 7).tolist()):
        what, change = f"the zero is off by {angle:+.2f} rad", partial(_positions, zero=angle * np.eye(arm.n)[j])
        yield Hypothesis("zero", ("q",), (j,), what, "", change, of_arm=True)


def _units(arm: RigidArm, motion: ChannelMotion) -> Iterator[Hypothesis]:
    """A factor in all torques, or in those of one joint."""
    channel, every = motion.channel, tuple(range(arm.n))
    for joints in [every, *((j,) for j in range(arm.n) if arm.n > 1)]:
        column = channel if len(joints) == arm.n else f"{channel}_{joints[0] + 1}"
        constant = "N·m/A at the joint" + (", or one for each joint: K1;K2;…" if len(joints) == arm.n > 1 else "")
        option = f"--units {column}=A:K ({constant}), or {column}=N·m if this is right"
        for factor in UNIT_FACTORS.tolist():
            what = f"the torque is {factor:.2g} times what the model explains: is it in amperes, or in another unit?"
            change = partial(_torques, factor=np.where(np.isin(every, joints), 1.0 / factor, 1.0))
            yield Hypothesis("scale", (channel,), joints, what, option, change, choices=2, corrects=False)


def _sources(arm: RigidArm, motion: ChannelMotion, stated: Corrections) -> Iterator[Hypothesis]:
    every, channel = tuple(range(arm.n)), motion.channel
    if not stated.without_gravity and arm.n > 1:
        what = (
            "the torque contains no gravity, so the program that recorded it has probably subtracted the gravity of "
            "the model"
        )
        change = partial(_weighed, arm=arm)
        yield Hypothesis("effort_source", (channel,), every, what, f"--effort-is {WITHOUT_GRAVITY}", change)
    if not (motion.rubs or stated.effort) and arm.n > 1:
        what = (
            "the torque contains friction, which a sensor on the link side does not measure, so it is the torque "
            "of the motors"
        )
        change = partial(replace, channel="tau_motor", rubs=True)
        yield Hypothesis("effort_source", (channel,), every, what, "--effort-is motor", change)


def _delays(arm: RigidArm, motion: ChannelMotion, stated: Corrections) -> Iterator[Hypothesis]:
    channel, every = motion.channel, tuple(range(arm.n))
    if channel in stated.clock:
        return
    rate = (len(motion.q) - 1) / max(motion.duration, 1e-9)
    early, late = DRIVE_DELAYS[channel]
    delays = np.arange(-LONGEST_DELAY, LONGEST_DELAY + DELAY_STEP, DELAY_STEP)
    for rows in np.unique(np.round(delays * rate).astype(int)).tolist():
        lag = rows / rate
        if early <= lag <= late or 4 * abs(rows) > len(motion.q):
            continue
        what = f"the torque is {abs(lag):.2f} s {'later' if lag > 0 else 'earlier'} than the positions"
        change = partial(_delayed, rows=rows)
        yield Hypothesis("clock", (channel,), every, what, f"--clock {channel}={-lag:.3f}", change, choices=2)


def _orders(arm: RigidArm, motion: ChannelMotion, follows: Sequence[str]) -> Iterator[Hypothesis]:
    """Two exchanged columns, and two torques that change places within the recording."""
    for channels, joints in exchangeable(arm, motion, follows):
        for pair in combinations(joints, 2):
            order = exchanged(tuple(range(arm.n)), pair)
            whole = put_in_order(arm, order, channels, motion.channel)
            yield whole
            for late, share in product((False, True), ORDER_CHANGES.tolist()) if "q" not in channels else ():
                part = f"in the part {'after' if late else 'before'} {share:.0%} of the recording"
                yield replace(
                    whole,
                    what=f"{whole.what}, but only {part}: with this change the model explains more",
                    option=f"give both parts as separate recordings, the {'later' if late else 'earlier'} part with "
                    f"{whole.option}",
                    change=partial(_in_part, order=order, late=late, share=share),
                    choices=3,
                    corrects=False,
                )


def exchangeable(
    arm: RigidArm, motion: ChannelMotion, follows: Sequence[str]
) -> list[tuple[tuple[str, ...], list[int]]]:
    """Channels whose columns may be in another order, and the joints: of torques or positions alone only those that
    are judged, or the readings that count would not be the same before and after."""
    positions, judged = ("q", *follows), np.flatnonzero(motion.count).tolist()
    return [((*positions, motion.channel), [*range(arm.n)]), (positions, judged), ((motion.channel,), judged)]


def exchanged(order: tuple[int, ...], pair: tuple[int, int]) -> tuple[int, ...]:
    places = dict(zip(pair, pair[::-1], strict=True))
    return tuple(order[places.get(j, j)] for j in range(len(order)))


def put_in_order(arm: RigidArm, order: tuple[int, ...], channels: Sequence[str], torque: str) -> Hypothesis:
    touched = tuple(j for j, other in enumerate(order) if j != other)
    names = ", ".join(arm.names[j] for j in touched)
    what = (
        f"the columns are in another order (the columns of {names} hold "
        f"{', '.join(arm.names[order[j]] for j in touched)})"
    )
    option = "--map " + ",".join(f"{name}_{j + 1}={name}_{order[j] + 1}" for name in channels for j in touched)

    def change(motion: ChannelMotion) -> ChannelMotion:
        motion = _positions(motion, order) if "q" in channels else motion
        return _torques(motion, order) if torque in channels else motion

    readings = order if torque in channels else ()
    return Hypothesis("order", tuple(channels), touched, what, option, change, len(touched) - 1, readings=readings)


def _positions(
    motion: ChannelMotion, order: Sequence[int] | None = None, factor: Array | float = 1.0, zero: Array | float = 0.0
) -> ChannelMotion:
    """The motion with positions in another order, unit or sign, or with other zeros, and with what follows them."""
    every = range(motion.q.shape[1]) if order is None else order
    q, v, a = (factor * x[:, list(every)] for x in (motion.q, motion.v, motion.a))
    return replace(motion, q=q + zero, v=v, a=a)


def _torques(motion: ChannelMotion, order: Sequence[int] | None = None, factor: Array | float = 1.0) -> ChannelMotion:
    """The motion with readings in another order, unit or sign."""
    every = list(range(motion.q.shape[1]) if order is None else order)
    size, least = (np.abs(factor) * x[every] for x in (motion.size, motion.least))
    read, count, idle = factor * motion.reading[:, every], motion.count[every], motion.idle[every]
    return replace(motion, reading=read, size=size, count=count, least=least, idle=idle)


def _signed(motion: ChannelMotion, arm: RigidArm, joint: int) -> ChannelMotion:
    """A reading with the sign of the torque that the model, friction and an offset predict for it."""
    model, way = arm.carried(motion.q, motion.v, motion.a)[:, joint], motion.direction[:, joint]
    amount = np.abs(motion.reading[:, joint])
    columns = np.stack([model, way, motion.v[:, joint], np.ones_like(way)], axis=1)
    predicted = model if motion.channel == "tau" else model + np.median(amount) * way
    for _ in range(REWEIGHINGS):  # after which signs and the torque that they tell agree
        signed = amount * np.sign(predicted)
        predicted = columns @ np.linalg.lstsq(columns, signed, rcond=None)[0]
    reading = motion.reading.copy()
    reading[:, joint] = signed
    return replace(motion, reading=reading)


def _weighed(motion: ChannelMotion, arm: RigidArm) -> ChannelMotion:
    return replace(motion, reading=motion.reading + arm.gravity_torque(motion.q))


def _delayed(motion: ChannelMotion, rows: int) -> ChannelMotion:
    """Readings taken so many rows later than the motion; NaN where there is none."""
    reading = np.full_like(motion.reading, np.nan)
    reading[max(0, -rows) : len(reading) - max(0, rows)] = motion.reading[max(0, rows) : len(reading) + min(0, rows)]
    return replace(motion, reading=reading)


def _in_part(motion: ChannelMotion, order: Sequence[int], late: bool, share: float) -> ChannelMotion:
    """An order of the readings before, or after, a share of the rows."""
    row, moved = round(share * len(motion.q)), motion.reading[:, list(order)]
    before, after = (motion.reading, moved) if late else (moved, motion.reading)
    return replace(motion, reading=np.concatenate([before[:row], after[row:]]))
