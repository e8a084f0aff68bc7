"""Stowing the arm in a pose of its file before its drives lose their power: for drives that let go without a host."""

import logging
import math
from contextlib import closing
from typing import Protocol

import numpy as np

from armlink.arm_file import ArmFile, LinkSection
from armlink.arrays import Array
from armlink.errors import BadInput, Refused
from armlink.link.guard import Crossed, Guard
from armlink.link.joints.groups import Group, traits_of
from armlink.link.types import Command, Sample, Samples, Setpoints, Tell

PEAK = 1.875
"""Peak speed over mean speed of the path, whose parameter is 10 s³ − 15 s⁴ + 6 s⁵."""
LAG = 0.2
"""A joint that stays this far behind its target on the way is blocked [rad]."""
REST_SECONDS = 0.5
"""The arm rests in its pose for this long before the power goes [s]."""
STOWED = 0.1
"""A joint that is further than this from its pose has not arrived [rad]."""
TELL_EVERY = 0.5
"""[s]."""
log = logging.getLogger("armlink")


class Parked(Protocol):
    """The part of a link that parking needs."""

    arm: ArmFile
    section: LinkSection
    names: tuple[str, ...]
    n: int
    period: float
    groups: tuple[Group, ...]

    @property
    def enabled(self) -> bool:
        """Whether the joints are enabled."""
        ...

    @property
    def latest_position(self) -> Array:
        """Newest position readings (n,) [rad]."""
        ...

    def cycle(self, command: Command) -> Sample:
        """One cycle."""
        ...

    def play(self, setpoints: Setpoints) -> Samples:
        """One row a cycle."""
        ...

    def disable(self) -> None:
        """Take the power from every joint."""
        ...


def let_go(link: Parked) -> list[str]:
    """Joints whose drives do not hold on their own when their host falls silent."""
    traits = traits_of(link.groups, link.n)
    return [name for name, each in zip(link.names, traits, strict=True) if each.silence != "holds"]


def require_deadman(link: Parked) -> None:
    """Raise Refused where a drive keeps its last command when its host dies."""
    traits = traits_of(link.groups, link.n)
    for name, each in zip(link.names, traits, strict=True):
        if each.silence == "keeps on":
            raise Refused(
                f"{name}: nothing stops its drive when this host dies (silence: keeps on): it is not driven; give it a "
                "firmware or a setting that watches its host"
            )


def park(link: Parked, tell: Tell) -> None:
    """Move the arm to `link.park`, let it rest there, and take the power from every joint.

    The joints move together on a straight line in joint space, which must be clear. `tell` is told how far it is.
    Raises BadInput where the arm file has no such pose, Refused where a joint is blocked (the joints then hold where
    they stand), BusFault.
    """
    stowed = link.section.park
    if stowed is None:
        raise BadInput(f"{link.arm.path}: key link.park is missing: give the pose in which the arm rests without power")
    goal = np.array(stowed.pose)
    start = link.cycle(Command.hold(link.latest_position)).position
    start = np.where(np.isfinite(start), start, link.latest_position)
    path = straight(start, goal, speeds(link, stowed.speed), link.period)
    away = np.full(link.n, np.inf)
    guard = Guard(-away, away, np.full(link.n, LAG))
    every = max(1, round(TELL_EVERY / link.period))
    try:
        with closing(link.play(Setpoints.follow(path, guard))) as samples:
            for row, _ in enumerate(samples):
                if row % every == 0:
                    tell(f"park: {row / len(path):.0%}")
    except Crossed as crossed:
        link.cycle(Command.hold(link.latest_position))
        raise Refused(f"park: {crossed}: something is in the way, or its drive is too weak; the joints hold") from None
    for _ in range(max(1, round(REST_SECONDS / link.period))):
        link.cycle(Command.hold(goal))
    off = np.abs(link.latest_position - goal)
    if (off > STOWED).any():
        joint = int(np.argmax(off))
        raise Refused(f"park: {link.names[joint]}: {off[joint]:.2f} rad from its pose: the joints hold")
    tell("park: power off")
    link.disable()


def leave(link: Parked, tell: Tell) -> None:
    """The end of work in order: park where drives would let the arm fall, else leave it as it is. Raises as `park`."""
    falling = let_go(link)
    if not link.enabled or not falling:
        return
    if link.section.park is None:
        log.warning(
            "%s: %s: the drives do not hold without their host, and the arm file has no link.park: the arm sinks or "
            "falls now",
            link.arm.name,
            ", ".join(falling),
        )
        return
    park(link, tell)


def straight(start: Array, goal: Array, speed: Array, period: float) -> Array:
    """Positions (K, n) [rad], one a cycle of `period` [s], from start to goal; no joint exceeds its speed [rad/s]."""
    seconds = PEAK * float(np.max(np.abs(goal - start) / speed, initial=0.0))
    count = max(1, math.ceil(seconds / period))
    s = np.arange(1, count + 1) / count
    way: Array = s**3 * (10 - 15 * s + 6 * s**2)
    return start + way[:, None] * (goal - start)


def speeds(link: Parked, speed: float) -> Array:
    """The speed of a way to park, no joint beyond what it may turn at (n,) [rad/s]."""
    fastest: Array = np.minimum(speed, np.array([joint.max_velocity for joint in link.section.joints]))
    return fastest
