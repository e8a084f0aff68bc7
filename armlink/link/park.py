"""Stowing an arm before its drives lose their power: in a pose of its file, or let down along its own load."""

import math
from typing import Protocol

import numpy as np

from armlink.arm_file import ArmFile, LinkSection
from armlink.arrays import Array
from armlink.errors import BadInput, BusFault, Refused
from armlink.link.cycle import Commander
from armlink.link.joints.groups import Group, traits_of
from armlink.link.types import Sample, Tell

PEAK_SPEED_RATIO = 1.875
"""Peak speed over mean speed of the path, whose parameter is 10 s³ − 15 s⁴ + 6 s⁵."""
BLOCKED_LAG = 0.2
"""A joint that stays this far behind its target on the way is blocked [rad]."""
REST_SECONDS = 0.5
"""The arm rests in its pose for this long before the power goes [s]."""
POSE_TOLERANCE = 0.1
"""A joint that is further than this from its pose has not arrived [rad]."""
TELL_SECONDS = 0.5
"""Time between two reports of progress [s]."""
LOWERING_SPEED = 0.1
"""An arm without a pose to park in is let down no faster [rad/s]: a hand's width a second at an arm's length."""
LIGHT_LOAD = 0.05
"""Share of max_torque below which a load lets its joint down more slowly, so that it comes to rest where it hangs."""
LOWERED_WAY = 0.01
"""An arm whose joints have all moved less than this within LOWERED_SECONDS rests [rad]."""
LOWERED_SECONDS = 2.0
"""See LOWERED_WAY [s]."""
LONGEST_LOWERING = 60.0
"""The power goes then, whether the arm rests or not [s]: half a turn at LOWERING_SPEED takes half of it."""


class StowableArm(Protocol):
    arm: ArmFile
    section: LinkSection
    names: tuple[str, ...]
    n: int
    period: float
    groups: tuple[Group, ...]
    commander: Commander

    @property
    def enabled(self) -> bool: ...

    @property
    def held(self) -> bool:
        """Whether the joints are held by the host alone."""

    @property
    def falls(self) -> bool:
        """Whether some drive lets go when its host falls silent."""

    @property
    def latest_position(self) -> Array:
        """Newest position readings (n,) [rad]."""

    def keep(self, goal: Array | None = None) -> Sample:
        """One cycle that holds every joint that can be held, or leads it towards `goal` (n,) [rad]."""

    def stop(self) -> None: ...

    def let_go(self) -> None: ...

    def disable(self) -> None: ...


def falling_joints(link: StowableArm) -> list[str]:
    """Joints whose drives do not hold on their own when their host falls silent."""
    traits = traits_of(link.groups)
    return [name for name, each in zip(link.names, traits, strict=True) if each.silence != "holds"]


def require_deadman(link: StowableArm) -> None:
    """Raise Refused where a drive keeps its last command when its host dies, and no keeper stops it."""
    traits = traits_of(link.groups)
    for name, each in zip(link.names, traits, strict=True):
        if each.reaction(link.section.keeper) == "keeps on":
            instead = ", or set `link.keeper: true` (docs/safety.md, keeper)" if each.kept else ""
            raise Refused(
                f"{name}: if this host dies, the drive continues its last command (`silence: keeps on`), so "
                "this joint is not enabled: choose a firmware or a setting with which the drive monitors its "
                f"host{instead}"
            )


def park(link: StowableArm, tell: Tell) -> None:
    """Move the arm to `link.park`, let it rest there, and take the power from every joint.

    The joints move together on a straight line in joint space, which must be clear; one that cannot be held is left
    out. `tell` is told how long it still takes. Raises BadInput where the arm file has no such pose, Refused where a
    joint is blocked (the joints then hold where they stand), BusFault where nothing can be sent.
    """
    stowed = link.section.park
    if stowed is None:
        raise BadInput(
            f"{link.arm.path}: key `link.park` is missing: give the pose in which the arm can rest without power"
        )
    goal = np.array(stowed.pose)
    link.keep()
    window = np.array([(each.lower, each.upper) for each in link.commander.limits]).T
    # a joint outside its window is led back into it by the gate; one that cannot be held has no way to go
    start = np.where(link.commander.held, np.clip(link.latest_position, *window), goal)
    path = straight_path(start, goal, path_speeds(link, stowed.speed), link.period)
    every = cycle_count(link, TELL_SECONDS)
    for row, target in enumerate(path):
        if row % every == 0:
            left = (len(path) - row) * link.period + REST_SECONDS
            tell(f"the arm moves to its parking pose, {left:.0f} s left; pressing Ctrl-C twice lets the arm fall")
        link.keep(target)
        how = "stopped following its target (something is in the way, or its drive is too weak)"
        _require_following(link, target, BLOCKED_LAG, how)
    for _ in range(cycle_count(link, REST_SECONDS)):
        link.keep(goal)
    _require_following(link, goal, POSE_TOLERANCE, "did not arrive at its parking position")
    _power_off(link)
    tell("the arm is in its parking pose, and its power is off")


def _power_off(link: StowableArm) -> None:
    """Take the power; a joint that could not be held need not tell that it is off."""
    lost = not all(link.commander.held)
    try:
        link.disable()
    except BusFault:
        if not lost:
            raise


def _require_following(link: StowableArm, target: Array, most: float, how: str) -> None:
    """Raise Refused, the joints holding, where one that is held is further than `most` [rad] from its target."""
    here = link.latest_position
    off = np.where(link.commander.held, np.abs(here - target), 0.0)
    joint = int(np.argmax(off))
    if off[joint] > most:
        link.keep(here)
        raise Refused(
            f"park: {link.names[joint]} is at {here[joint]:.3f} rad, its target is {target[joint]:.3f} rad: it "
            f"{how}; all joints hold where they stand"
        )


def let_down(link: StowableArm, tell: Tell, why: str) -> None:
    """Lower the arm as its own load pulls it, slowly, until it rests; then take the power.

    Each joint moves against the torque that its drive makes to hold it: downhill, whatever the arm carries, and away
    from what it presses on. Raises BusFault where nothing can be sent.
    """
    target = before = link.latest_position
    step = path_speeds(link, LOWERING_SPEED) * link.period
    light = LIGHT_LOAD * np.array([joint.max_torque for joint in link.section.joints])
    lower, upper = np.array([(each.lower, each.upper) for each in link.commander.limits]).T
    every, window = cycle_count(link, TELL_SECONDS), cycle_count(link, LOWERED_SECONDS)
    for row in range(cycle_count(link, LONGEST_LOWERING)):
        if row % every == 0:
            tell(
                "the arm could not be parked, so it is being lowered, which takes at most "
                f"{LONGEST_LOWERING - row * link.period:.0f} s: {why}"
            )
        load = np.nan_to_num(np.array(link.commander.loop.latest_motor_torque))
        here = link.latest_position
        target = np.clip(
            target - step * np.clip(load / light, -1.0, 1.0),
            np.maximum(here - BLOCKED_LAG, lower),
            np.minimum(here + BLOCKED_LAG, upper),
        )
        link.keep(target)
        if row % window == window - 1:
            here = link.latest_position
            if np.abs(here - before).max() < LOWERED_WAY:
                break
            before = here
    _power_off(link)
    tell("the arm has been lowered, and its power is off")


def straight_path(start: Array, goal: Array, speed: Array, period: float) -> Array:
    """Positions (K, n) [rad], one a cycle of `period` [s], from start to goal; no joint exceeds its speed [rad/s]."""
    seconds = PEAK_SPEED_RATIO * float(np.max(np.abs(goal - start) / speed, initial=0.0))
    count = max(1, math.ceil(seconds / period))
    s = np.arange(1, count + 1) / count
    way: Array = s**3 * (10 - 15 * s + 6 * s**2)
    return start + way[:, None] * (goal - start)


def path_speeds(link: StowableArm, speed: float) -> Array:
    """The speed of a way to park, no joint beyond what it may turn at (n,) [rad/s]."""
    fastest: Array = np.minimum(speed, np.array([joint.max_velocity for joint in link.section.joints]))
    return fastest


def cycle_count(link: StowableArm, seconds: float) -> int:
    """Cycles in so many seconds, at least one."""
    return max(1, round(seconds / link.period))
