"""Messages of joint states from a program that commands an arm, as a bus that can only be listened to.

A message becomes frames of this process: one that begins a cycle, then one for each joint that the message names. So
whatever listens to drives on CAN (monitor, recorder, listener, daemon) listens to such a program too. A cycle begins
with each message that names a joint of which the cycle has a reading already: of publishers that tell a part of the
joints each, all parts make one cycle.

What is wrong with a message is left out, counted and said; nothing of it is a statement about the arm's hardware.
"""

import logging
import math
import struct
from collections import Counter, deque
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import NamedTuple, Protocol

from armlink.arm_file import LinkSection
from armlink.bus.can_bus import CanBus
from armlink.bus.in_process import InProcessBus, InProcessPort
from armlink.bus.port import Frame, Stamped
from armlink.clock import Clock, MonotonicClock
from armlink.errors import BadInput, BusFault

JOINT_STATE_FAMILY = "joint_state"
"""Drive family of joints that a program tells of (`armlink.drives.joint_state`)."""
CYCLE_ID, READING_ID, TARGET_ID = 0x080, 0x100, 0x180
"""Identifiers of this process's frames; the joint's place in the arm is added to the last two."""
MOST_JOINTS = TARGET_ID - READING_ID
READING, TARGET = struct.Struct("<ddd"), struct.Struct("<d")
"""Position [rad], velocity [rad/s] and effort of a joint; target position [rad]. NaN where the message has none."""
POLL_SECONDS = 2e-3
"""Time between two looks for messages while somebody waits for one [s]."""
LATE_SECONDS = 1.0
"""A time stamp that is older than the newest by more than this is no late message: its clock was set back [s]."""
CLOCK_DRIFT = 1e-4
"""Clocks of two computers may run apart so fast [1]: IEEE 802.3 allows each ±100 ppm."""
LEAST_STEP = 1e-6
"""Least time from a message to the next [s]."""
OWNER_SECONDS = 1.0
"""A joint belongs to the publisher that told of it within this time [s]."""
RATE_SECONDS, RATE_SHARE = 5.0, 0.2
"""The rate of readings is measured for this time [s], and may differ from that of the arm file by this share."""
MOST_FOREIGN = 12
"""So many joints that are not in the arm file are named."""

log = logging.getLogger("armlink")


class JointStateMessage(NamedTuple):
    """One message as it came; a column that it lacks is empty."""

    source: Hashable
    """Who sent it."""
    arrived: float
    """By the machine's monotonic clock [s]."""
    stamp: float
    """When the readings were taken, by the sender's clock [s]; NaN where it does not tell."""
    names: Sequence[str]
    position: Sequence[float]
    """[rad]."""
    velocity: Sequence[float] = ()
    """[rad/s]."""
    effort: Sequence[float] = ()
    """Torque [N·m] or current [A], as the arm file says."""
    target: Sequence[float] = ()
    """Commanded position [rad]."""


class JointMessageSource(Protocol):
    """Where messages come from. It has no way to send."""

    @property
    def lost(self) -> int:
        """Messages that are known to be lost on the way."""

    def take(self) -> list[JointStateMessage]:
        """All messages that are there, in their order; does not wait. Raises BusFault."""

    def absence(self) -> str:
        """Advice where no message comes, as the end of a sentence."""

    def close(self) -> None: ...


class SenderClock:
    """Times of messages by this machine's clock: the sender's stamps, shifted by the shortest way so far."""

    def __init__(self, first: Iterable[tuple[float, float]] = ()) -> None:
        """`first`: stamps and arrivals of the messages that waited when listening began: their times are known apart,
        although they arrived together."""
        self._stamp = self._arrived = self._time = -math.inf
        told = (arrived - stamp for stamp, arrived in first if math.isfinite(stamp) and stamp != 0.0)
        self._shift = min(told, default=math.inf)

    def time(self, stamp: float, arrived: float) -> float | None:
        """Time of a message [s], later than that of the message before; None if its stamp is not newer."""
        if not (math.isfinite(stamp) and stamp != 0.0):
            return self._later(arrived)
        if self._stamp - LATE_SECONDS <= stamp <= self._stamp:
            return None
        if stamp < self._stamp:
            log.warning(
                "the time stamps of joint states went back by %.1f s: armlink makes the times of samples increase",
                self._stamp - stamp,
            )
            self._shift = math.inf
        slack = CLOCK_DRIFT * max(arrived - self._arrived, 0.0) if math.isfinite(self._arrived) else 0.0
        self._shift = min(self._shift + slack, arrived - stamp)
        self._stamp, self._arrived = stamp, arrived
        return self._later(stamp + self._shift)

    def _later(self, time: float) -> float:
        self._time = max(time, self._time + LEAST_STEP)
        return self._time


class ListeningBus(InProcessBus):
    """Frames of the messages of one source. There is nothing that could send: `put` is an error."""

    ended = False

    def __init__(
        self,
        source: JointMessageSource,
        name: str,
        joints: Sequence[str],
        torque_constants: Mapping[str, float] | None = None,
        rate: float = math.nan,
        clock: Clock | None = None,
    ) -> None:
        """`joints` are the names that messages have for the arm's joints, in the arm's order; `torque_constants` of
        those whose effort is a current, unless the arm file says otherwise [N·m/A]; `rate` that the arm file has for
        readings [Hz]."""
        self.channel_info, self.clock, self.torque_constants = name, clock, torque_constants or {}
        self._source, self._machine = source, clock or MonotonicClock()
        self._place = {joint: place for place, joint in enumerate(joints)}
        self._frames: deque[Stamped] = deque()
        self._clocks: dict[Hashable, SenderClock] = {}
        self._owners: dict[str, tuple[Hashable, float]] = {}
        """Joint → who tells of it, and when it last did."""
        self._in_cycle: set[str] = set()
        self._open = False
        """Whether a cycle has begun."""
        self._now, self._first = 0.0, math.nan
        self._rate, self._cycles, self._began = rate, 0, math.nan
        self.remarks: Counter[str] = Counter()
        """Parts of messages that were left out: why, and how often."""
        self._foreign: dict[str, None] = {}
        """Joints of messages that name none of the arm's."""

    @property
    def dropped(self) -> int:
        return self._source.lost

    def stamp(self) -> float:
        return self._now - self._first

    def take(self, timeout: float = 0.0) -> Frame | None:
        self._fill(timeout)
        if not self._frames:
            return None
        self._now, can_id, data = self._frames.popleft()
        self._first = self._now if math.isnan(self._first) else self._first
        return can_id, data

    def take_all(self) -> list[Stamped]:
        self._fill(0.0)
        taken = list(self._frames)
        self._frames.clear()
        return taken

    def wait(self, timeout: float) -> None:
        self._fill(timeout)

    def recv(self, timeout: float | None = None) -> None:
        """There are no CAN frames to be logged or timed; raises BadInput."""
        raise BadInput(
            f"{self.channel_info}: there are no CAN frames, so leave out --frames and --stats: armlink hears messages "
            "of the program that commands the arm"
        )

    def put(self, can_id: int, data: bytes) -> None:
        raise BusFault(f"{self.channel_info}: this bus is listen-only: nothing can be sent")

    def open_listening_port(self) -> "ListeningPort":
        return ListeningPort(self)

    def shutdown(self) -> None:
        self._source.close()

    def silence(self) -> str:
        """Why no joint of the arm is heard, in one line."""
        if self._open:
            return "; ".join((f"messages have stopped: {self._source.absence()}", *self.said()))
        if self._foreign:
            named, ours = list(self._foreign), ", ".join(self._place)
            more = f" and {len(named) - MOST_FOREIGN} others" if len(named) > MOST_FOREIGN else ""
            return (
                f"the messages name the joints {', '.join(named[:MOST_FOREIGN])}{more}, and none of {ours}: give each "
                f"joint its name in the messages (`drive: {{family: {JOINT_STATE_FAMILY}, joint: NAME}}`)"
            )
        if self.remarks:
            return "; ".join(self.said())
        return f"no message has come: {self._source.absence()}"

    def said(self) -> list[str]:
        """Parts of messages that were left out so far, one sentence each."""
        return [f"{what} ({count} times)" for what, count in self.remarks.items()]

    def _fill(self, timeout: float) -> None:
        """Take messages in until there is a frame, for at most `timeout` seconds."""
        end = self._machine.now() + timeout
        while True:
            messages = self._source.take()
            for source in {message.source for message in messages} - self._clocks.keys():
                first = ((each.stamp, each.arrived) for each in messages if each.source == source)
                self._clocks[source] = SenderClock(first)
            for message in messages:
                self._take_message(message)
            now = self._machine.now()
            if self._frames or now >= end:
                return
            self._machine.sleep_until(min(now + POLL_SECONDS, end))

    def _take_message(self, message: JointStateMessage) -> None:
        named = [(number, name) for number, name in enumerate(message.names) if name in self._place]
        if not named:
            if len(self._foreign) < 10 * MOST_FOREIGN:
                self._foreign |= dict.fromkeys(message.names)
            return
        owned = [(number, name) for number, name in named if self._owns(message, name)]
        if len(owned) < len(named):
            twice = ", ".join(name for number, name in named if (number, name) not in owned)
            self._remark(f"two publishers send {twice}: armlink uses the first one")
        if not owned:
            return
        time = self._clocks[message.source].time(message.stamp, message.arrived)
        if time is None:
            self._remark("messages came late or twice: their time stamps are not newer than earlier ones")
            return
        heard = {name for _, name in owned}
        readings = [frame for number, name in owned for frame in self._reading(message, number, name)]
        if not readings:
            return
        targets = [frame for number, name in owned for frame in self._target(message, number, name)]
        self._frames.extend((time, *frame) for frame in targets)  # given before the readings
        if not self._open or self._in_cycle & heard:
            self._open, self._in_cycle = True, set()
            self._mind_rate(time)
            self._frames.append((time, CYCLE_ID, b""))
        self._in_cycle |= heard
        self._frames.extend((time, *frame) for frame in readings)

    def _mind_rate(self, time: float) -> None:
        """Say once if cycles come at another rate than the arm file has: the observer averages by it."""
        self._began = time if math.isnan(self._began) else self._began
        elapsed = time - self._began
        if elapsed >= RATE_SECONDS and self._cycles:
            found = self._cycles / elapsed
            if abs(found - self._rate) > RATE_SHARE * self._rate:
                self._remark(f"readings come at {found:.0f} Hz, and `link.rate` of the arm file is {self._rate:g} Hz")
            self._rate = math.nan
        self._cycles += 1

    def _owns(self, message: JointStateMessage, name: str) -> bool:
        owner, heard = self._owners.get(name, (message.source, message.arrived))
        if owner != message.source and message.arrived - heard < OWNER_SECONDS:
            return False
        self._owners[name] = message.source, message.arrived
        return True

    def _target(self, message: JointStateMessage, number: int, name: str) -> list[Frame]:
        target = self._value(message.target, number, name, "target")
        return [(TARGET_ID + self._place[name], TARGET.pack(target))] if math.isfinite(target) else []

    def _reading(self, message: JointStateMessage, number: int, name: str) -> list[Frame]:
        position = self._value(message.position, number, name, "position")
        velocity = self._value(message.velocity, number, name, "velocity")
        effort = self._value(message.effort, number, name, "effort")
        if not message.position:
            self._remark("messages have no position")
        elif not message.effort:
            self._remark("messages have no effort, so there is no torque")
        if not math.isfinite(position):
            return []
        return [(READING_ID + self._place[name], READING.pack(position, velocity, effort))]

    def _value(self, column: Sequence[float], number: int, name: str, what: str) -> float:
        if not column:
            return math.nan
        if number >= len(column):
            self._remark(f"messages have more joints than values of {what}: {name} has none")
            return math.nan
        value = float(column[number])
        if not math.isfinite(value):
            if what != "target":
                self._remark(f"{name}: the {what} in the message is not a number")
            return math.nan
        return value

    def _remark(self, what: str) -> None:
        if not self.remarks[what]:
            log.warning("%s: %s", self.channel_info, what)
        self.remarks[what] += 1


class ListeningPort(InProcessPort):
    """Frames with the times of their messages."""

    def __init__(self, bus: ListeningBus) -> None:
        super().__init__(bus)
        self.wait, self.take_all = bus.wait, bus.take_all


def message_names(section: LinkSection) -> list[str]:
    """Names that messages have for the arm's joints: as the arm file says, by default the joints' own."""
    found = [row.settings.joint if row.settings.family == JOINT_STATE_FAMILY else row.name for row in section.joints]
    if len(found) > MOST_JOINTS:
        raise BadInput(f"link.joints has {len(found)} joints: armlink can listen to at most {MOST_JOINTS} joints")
    return found


def silence_of(bus: CanBus, otherwise: str) -> str:
    """Why no joint is heard on a bus, in words; `otherwise` of a bus with drives."""
    return bus.silence() if isinstance(bus, ListeningBus) else otherwise


def remarks_of(bus: CanBus) -> list[str]:
    """Parts of messages that were left out so far, one sentence each; of a bus with drives none."""
    return bus.said() if isinstance(bus, ListeningBus) else []
