"""Motion for the judgement of an arm's scales: readings while a hand, this host or another one moves the arm."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from armlink.drives.orders import Order, Power
from armlink.errors import BusFault
from armlink.link.gate_limits import joint_ranges
from armlink.link.joints.groups import by_joint
from armlink.link.joints.values import JointValues
from armlink.link.link import Link
from armlink.link.listener import Listener
from armlink.link.park import TELL_SECONDS, path_speeds, straight_path
from armlink.link.types import Command, Sample, Setpoints, Tell
from armlink.selftest.scales import Evidence, ScaleFinding, ScaleTrack, gather_evidence, judge_scales

MOTION_REACH = 0.35
"""Distance by which this host moves every joint to both sides [rad]."""
MOTION_SPEED = 0.6
"""At most [rad/s]."""
CLEARANCE = 0.05
"""Distance that this host keeps from a stop [rad]."""
REST_SECONDS = 0.6
"""Rest at both ends of the motion [s]."""
CURRENT_READINGS = 3
"""Currents that are asked for at each end."""


@dataclass(frozen=True)
class JointScales:
    joint: str
    evidence: tuple[Evidence, ...]
    findings: tuple[ScaleFinding, ...]

    @property
    def judged(self) -> tuple[str, ...]:
        """Quantities that some evidence is about."""
        return tuple(dict.fromkeys(name for each in self.evidence for name in each.exponents))


class Tracks:
    """Readings and orders of n joints, sample by sample."""

    def __init__(self, values: JointValues, n: int) -> None:
        """`values` of the link or listener that they come from."""
        self._values, self._n = values, n
        self._rows: list[tuple[float, list[tuple[float, ...]]]] = []

    def add(self, sample: Sample, orders: Sequence[Order | None]) -> None:
        """One sample, with the orders that were given with it; torques as the drives report them."""
        motor = self._values.uncalibrated(sample.motor_torque)
        columns = zip(sample.position.tolist(), sample.velocity.tolist(), motor.tolist(), orders, strict=True)
        self._rows.append((sample.t, [(*readings, *_told(order)) for *readings, order in columns]))

    def of(self, joint: int) -> ScaleTrack:
        t = np.array([t for t, _ in self._rows])
        table = np.array([row[joint] for _, row in self._rows]).reshape(-1, 8)
        return ScaleTrack(t, *table.T)


def _told(order: Order | None) -> tuple[float, ...]:
    if order is None or order.power is not Power.ON:
        return (np.nan,) * 5
    return order.position, order.velocity, order.torque, order.kp, order.kd


def judge_by_hand(link: Link, tell: Tell, seconds: float) -> list[JointScales]:
    """Judge the readings while a person moves every joint from stop to stop; the drives have no power.

    The link is open and not started. Raises BusFault.
    """
    link.start(to_enable=False)
    tracks, end, told = Tracks(link.values, link.n), link.clock.now() + seconds, -np.inf
    low, high = np.full(link.n, np.inf), np.full(link.n, -np.inf)
    while (now := link.clock.now()) < end:
        sample = link.commander.stand([Power.OFF] * link.n)
        link.require_sound_bus()
        tracks.add(sample, [None] * link.n)
        low, high = np.fmin(low, sample.position), np.fmax(high, sample.position)
        if now - told >= TELL_SECONDS:
            told = now
            seen = ", ".join(f"{name} {way:.1f} rad" for name, way in zip(link.names, high - low, strict=True))
            tell(f"turn every joint from stop to stop, {end - now:.0f} s left: {seen}")
    return _judged(link.names, tracks, _ways(link), True, {})


def judge_by_motion(link: Link, tell: Tell) -> list[JointScales]:
    """Judge the readings while this host moves all joints a little, at the place where the arm stands.

    The link is open and not started; in the end the joints are enabled and hold. Raises Refused, BusFault.
    """
    link.start()
    link.enable()
    tracks, start = Tracks(link.values, link.n), link.latest_position
    ranges = np.array(joint_ranges(link.arm))
    least, most = ranges[:, 0] + CLEARANCE, ranges[:, 1] - CLEARANCE
    pairs: dict[int, list[tuple[float, float]]] = {joint: [] for joint in range(link.n)}
    for side in (1.0, -1.0, 0.0):
        goal = np.clip(start + side * MOTION_REACH, np.minimum(least, start), np.maximum(most, start))
        tell(
            f"moving all joints by {MOTION_REACH} rad to "
            f"{'the upper side' if side > 0 else 'the lower side' if side else 'their first position'}"
        )
        path = straight_path(link.position_sent, goal, path_speeds(link, MOTION_SPEED), link.period)
        rest = np.tile(goal, (max(1, round(REST_SECONDS / link.period)), 1))
        with closing(link.play(Setpoints.follow(np.vstack([path, rest])))) as samples:
            for sample in samples:
                tracks.add(sample, link.orders_sent)
        for joint, found in pairs.items():
            found += _currents(link, joint)
        link.cycle(Command.hold(goal))
    return _judged(link.names, tracks, _ways(link), False, pairs)


def judge_by_listening(listener: Listener, tell: Tell, seconds: float) -> list[JointScales]:
    """Judge the readings while another host moves the arm; nothing is sent. Raises BusFault."""
    tracks, end, told = Tracks(listener.values, listener.n), listener.clock.now() + seconds, -np.inf
    heard = 0
    while (now := listener.clock.now()) < end:
        sample = listener.next(min(0.5, end - now))
        if sample is not None:
            tracks.add(sample, listener.orders_sent)
            heard += 1
        if now - told >= TELL_SECONDS:
            told = now
            tell(f"{heard} cycles heard, {max(end - now, 0):.0f} s left")
    if not heard:
        raise BusFault(
            f"{listener.bus.channel_info}: no cycle of another host was heard: is a host running {listener.arm.name}?"
        )
    return _judged(listener.names, tracks, _ways(listener), False, {})


def _ways(source: Link | Listener) -> list[float]:
    return [upper - lower for lower, upper in joint_ranges(source.arm)]


def _currents(link: Link, joint: int) -> list[tuple[float, float]]:
    """Torque as reported and by current, a few times; nothing of a drive that does not tell its current."""
    group, number = by_joint(link.groups)[joint]
    found = [group.drives.torque_by_current(number, link.ask.on(group.tag)) for _ in range(CURRENT_READINGS)]
    return [each for each in found if each is not None]


def _judged(
    names: Sequence[str],
    tracks: Tracks,
    ways: Sequence[float],
    stop_to_stop: bool,
    pairs: dict[int, list[tuple[float, float]]],
) -> list[JointScales]:
    found = []
    for joint, name in enumerate(names):
        evidence = gather_evidence(tracks.of(joint), ways[joint], stop_to_stop, pairs.get(joint, ()))
        found.append(JointScales(name, tuple(evidence), tuple(judge_scales(evidence))))
    return found
