"""Before a sweep: are the sensors alive and quiet, the drives cool, and is every stop where the arm file has it?

A drive that gets too hot later says so by an emergency, which ends any sweep.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.link.joints.groups import make_groups, traits_of
from armlink.link.types import Stats
from armlink.loop.open import ArmDriver
from calib.arm.kinematics import DriveLimits
from calib.arm.sweep_section import sweep_section
from calib.motion.mover import Mover, Stalled
from calib.plan.planned_arm import PlannedArm
from gcomp.arrays import Array, Mask

LISTEN = 0.5
"""Seconds for which the sensors are listened to at rest, after as long again in which switching on dies down."""
MISSING, LATE = 0.1, 0.5
"""Shares of readings from which on they are said to be missing, and to be late."""
LOUD = 0.05
"""Noise of a torque sensor, as a share of rated torque, from which it is not fit for a calibration."""
SATURATION_RATIO = 1.9
"""Reading, in rated torques, at which a torque sensor is about to saturate."""
STOP_SEARCH_DISTANCE = 0.08
"""Distance from the arm file's stop from which a joint creeps [rad]."""
HOT = 70.0
"""Temperature of a drive from which no sweep is begun: it would fall or rise while the sensors are read [°C]."""


@dataclass(frozen=True, eq=False)
class Preflight:
    """Findings before a sweep; arrays (n,)."""

    names: tuple[str, ...]
    noise: Array
    """Standard deviation of one torque sample [N·m]."""
    torque: Array
    """Mean torque reading at rest [N·m]."""
    stops: Array
    """Readings at the lower and the upper stop (n, 2) [rad]; NaN where none was looked for."""
    expected: Array
    """Stops by the arm file (n, 2) [rad]."""
    temperature: Array
    """Of the drives (n,) [°C]; NaN where a drive does not report it."""
    left_out: tuple[str, ...] = ()
    """Stops that were to be pushed and were not: a sentence for each reason, with side and joint."""


def listen(link: ArmDriver, arm: ArmFile) -> Preflight:
    """Listen to an enabled arm at rest.

    Raises Refused naming the joint whose sensor is silent, loud or at the end of its range, or whose drive is hot.
    """
    temperature = read_temperatures(link)
    limits, mover = DriveLimits.of(arm), Mover(link, sweep_section(arm), DriveLimits.of(arm))
    cycles = max(int(LISTEN / link.period), 20)
    for _ in range(cycles):
        mover.cycle()
    before = link.stats
    samples = [mover.cycle() for _ in range(cycles)]
    torque = np.array([sample.torque for sample in samples])
    position = np.array([sample.position for sample in samples])
    every = [each.torque_cycles for each in traits_of(make_groups(arm))]
    _check_readings(link.names, before, link.stats, torque, position, every)
    for joint, name in enumerate(link.names):
        peak, limit = np.nanmax(np.abs(torque[:, joint])), SATURATION_RATIO * limits.rated[joint]
        if peak > limit:
            raise Refused(
                f"{name}: its torque sensor reads up to {peak:.3g} N·m at rest, near the end of its range (limit "
                f"{limit:.3g} N·m, {SATURATION_RATIO:g} × rated torque): unload the joint, or check the sensor"
            )
        noise = _noise(torque[:, joint])
        if noise > LOUD * limits.rated[joint]:
            raise Refused(
                f"{name}: the noise of its torque sensor is {noise:.3g} N·m, expected below {LOUD:.0%} of rated torque "
                f"({LOUD * limits.rated[joint]:.3g} N·m): check shielding and mounting, and that the arm stands still"
            )
    nowhere = np.full((link.n, 2), np.nan)
    expected = np.column_stack([limits.lower, limits.upper])
    mean = np.nanmean(torque, axis=0)
    return Preflight(link.names, np.array([_noise(each) for each in torque.T]), mean, nowhere, expected, temperature)


def _check_readings(
    names: tuple[str, ...], before: Stats, after: Stats, torque: Array, position: Array, torque_cycles: Sequence[int]
) -> None:
    """Raise Refused naming the joint whose readings are missing: lost on the way, or late.

    `before` and `after` count what was asked for and what came while torque and position (K, n) were read; a torque
    comes every so many cycles (n,).
    """
    asked = after.asked - before.asked
    for joint, name in enumerate(names):
        lost = asked - (after.came[joint] - before.came[joint])
        came = {"torque": ~np.isnan(torque[:, joint]), "position": ~np.isnan(position[:, joint])}
        for what, cycles in (("torque", torque_cycles[joint]), ("position", 1)):
            here, anything = (_any_in(each, cycles) for each in (came[what], came["torque"] | came["position"]))
            if (~here).sum() <= MISSING * len(here):
                continue
            empty = int((~here & anything).sum())
            for count, of in ((lost, asked), (empty, len(here))):
                if count > MISSING * of:
                    raise Refused(f"{name}: {count} of {of} {what} readings are missing: check its drive and cable")
            if (~here).sum() > LATE * len(here):
                raise Refused(
                    f"{name}: {(~here).sum()} of {len(here)} {what} readings came after the end of their cycle, so the "
                    "arm or this machine is too slow: lower link.rate, or stop other programs on this machine"
                )


def _any_in(came: Mask, cycles: int) -> Mask:
    """Whether a reading came in each stretch of so many cycles."""
    return np.asarray(came[: len(came) // cycles * cycles].reshape(-1, cycles).any(axis=1))


def read_temperatures(link: ArmDriver) -> Array:
    """Temperatures of the drives (n,) [°C], NaN where one does not report it; raises Refused naming one that is hot."""
    temperature = link.read_temperatures()
    for name, degrees in zip(link.names, temperature, strict=True):
        if degrees >= HOT:
            raise Refused(
                f"{name}: its drive is at {degrees:.0f} °C, but a sweep begins only below {HOT:.0f} °C: let it "
                "cool down"
            )
    return temperature


def find_stops(
    link: ArmDriver, arm: ArmFile, found: Preflight, report: Callable[[int, int], None] | None = None
) -> Preflight:
    """Push each joint slowly onto both its stops, no harder than its position loop does 15 mrad off, others mid-range.

    Raises Refused naming the joint and the place where a stop is not where the arm file has it. A stop that a joint
    does not get to, or on whose way bodies of the model touch, is left out, and `left_out` names it.
    """
    limits, planned = DriveLimits.of(arm), PlannedArm(arm)
    mover = Mover(link, planned.section, limits)
    mover.hold_all()
    middle = (limits.lower + limits.upper) / 2
    stops, left_out = np.full((link.n, 2), np.nan), dict[str, list[str]]()
    for count, joint in enumerate(reversed(range(link.n))):
        for end, side in enumerate((-1, 1)):
            goal, here = middle.copy(), mover.command.position.copy()
            goal[joint] = mover.before_stop(joint, side, STOP_SEARCH_DISTANCE)
            at_stop = goal.copy()
            at_stop[joint] = limits.lower[joint] if side < 0 else limits.upper[joint]
            ways = ([here, goal, at_stop], [here, middle, goal, at_stop])
            way = next((each for each in ways if all(planned.is_clear(*leg) for leg in pairwise(each))), None)
            name = f"the {'lower' if side < 0 else 'upper'} stop of {link.names[joint]}"
            if way is None:
                left_out.setdefault("bodies of the model would touch on the way", []).append(name)
            else:
                try:
                    for pose in way[1:-1]:
                        mover.travel(pose, 1.0)
                    push = np.zeros(link.n, dtype=np.int64)
                    push[joint] = side
                    stops[joint, end] = mover.touch(push)[joint]
                    mover.hold_all()
                    mover.travel(goal, 1.0)
                except Stalled:  # too heavy to hold there: the sweeps, which know the weight, look again
                    if np.isnan(stops[joint, end]):
                        left_out.setdefault("the joint did not get there", []).append(name)
                    mover.hold_all()
                    _travel_if_clear(mover, planned, middle)
            if report is not None:
                report(2 * count + end + 1, 2 * link.n)
    _travel_if_clear(mover, planned, middle)
    sentences = (f"not pushed, since {why}: {', '.join(names)}" for why, names in left_out.items())
    return replace(found, stops=stops, left_out=tuple(sentences))


def _travel_if_clear(mover: Mover, planned: PlannedArm, goal: Array) -> None:
    """Go straight to a pose (n,) [rad], or stay where the model's shapes are in the way."""
    if planned.is_clear(mover.command.position, goal):
        mover.travel(goal, 1.0)


def _noise(values: Array) -> float:
    """Standard deviation of one reading from the steps between readings, so that a slow change does not count."""
    steps = np.diff(values[np.isfinite(values)])
    return float(np.sqrt(np.mean(steps**2) / 2)) if len(steps) else float("nan")
