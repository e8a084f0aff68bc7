"""Listening to an arm that another controller commands: one sample a cycle of that controller; nothing is sent.

A cycle begins with SYNC; of drives without SYNC with the command to the joint that was commanded first. On SocketCAN
and udp_multicast it sleeps for several cycles and then takes all that came, each frame with the kernel's own time; on
other buses it wakes for each frame, whose time is when it was read.

The one exception is asked for by name: `write_calibration` and `read_calibration` ask the drives.
"""

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Self

from armlink.arm_file import ArmFile, LinkJoint
from armlink.arrays import Array
from armlink.bus.adapters import as_bus
from armlink.bus.can_bus import CanBus
from armlink.bus.listening.joint_messages import JOINT_STATE_FAMILY, ListeningBus
from armlink.bus.port import Port, StampedPort
from armlink.clock import Clock, MonotonicClock
from armlink.drives.board import DriveEvent
from armlink.drives.family import family
from armlink.drives.orders import Order
from armlink.drives.traits import Traits
from armlink.link.cyclic_exchange import Loop
from armlink.link.joints.ask import LinkAsk
from armlink.link.joints.calibrations import Calibrations
from armlink.link.joints.foreign_host import Commands, ForeignHost
from armlink.link.joints.groups import make_groups, traits_of
from armlink.link.joints.values import values_of
from armlink.link.joints.whole_turns import PlaceWatch
from armlink.link.types import Sample, Stats

if TYPE_CHECKING:
    import can

SLEEP_SECONDS = 0.04
"""Frames with a time stamp may wait for this long [s]: ten cycles at 250 Hz, half of what a small receive queue holds
of a full bus."""

CLOCK_RESOLUTION = 1e-9
"""Times closer than this are the same [s]: a simulated clock may not move by less."""


def heard_arm(arm: ArmFile, bus: CanBus) -> ArmFile:
    """The arm as it is heard on `bus`: where that carries messages about joints in place of frames of drives, every
    joint is one that messages tell of."""
    if not isinstance(bus, ListeningBus):
        return arm
    section, constants = arm.require_link(), bus.torque_constants
    told = zip(section.joints, traits_of(make_groups(arm)), strict=True)
    joints = tuple(_told_joint(row, traits, constants.get(row.name)) for row, traits in told)
    return arm.model_copy(update={"link": section.model_copy(update={"joints": joints})})


def _told_joint(row: LinkJoint, traits: Traits, torque_constant: float | None) -> LinkJoint:
    """A joint of a drive on CAN, of which another program tells by the joint's name: its positions are those of the
    joint, and its efforts come from where the drive has them."""
    if row.settings.family == JOINT_STATE_FAMILY:
        return row
    effort = "torque" if traits.torque == "link" else "motor"
    keys: dict[str, object] = {"effort": effort, "calibration": traits.calibration}
    if torque_constant is not None:
        keys = {"effort": "current", "torque_constant": torque_constant}
    drive = family(JOINT_STATE_FAMILY).settings.model_validate(
        {"family": JOINT_STATE_FAMILY, "joint": row.name, **keys}
    )
    return row.model_copy(update={"node": None, "drive": drive, "bus": ""})


class HeardArm:
    """An arm on a bus whose joints another host commands: what a listener knows of its drives, and of that host."""

    def __init__(self, arm: ArmFile, bus: CanBus) -> None:
        """Nothing is heard before `listen_on`; the bus's own clock counts if it has one, else the machine's."""
        self.arm = heard = heard_arm(arm, bus)
        self.section = section = heard.require_link()
        self.names = tuple(joint.name for joint in section.joints)
        self.n, self.period = len(self.names), 1.0 / section.rate
        self.clock: Clock = bus.clock or MonotonicClock()
        self.lock_step = bus.clock is not None
        self.groups = make_groups(heard, bus)
        self.values = values_of(heard, self.groups)
        self.places = PlaceWatch(arm, self.values)
        """Joints that cannot stand where they read."""

    def listen_on(self, port: Port, unknown: Callable[[int, bytes], None], forgets: bool = False) -> None:
        """Take the joints' frames from `port`; `unknown` gets those that no drive sends. `forgets` as ForeignHost."""
        self._loop = Loop(port, self.clock, self.groups, self.values, self.period, self.lock_step)
        self._loop.on_unknown = unknown
        self._host = ForeignHost(self.groups, self.values, forgets)

    def take_sample(self, now: float) -> Sample:
        """Readings since the last sample, as of time `now`; they are of no later one."""
        sample = self._loop.sample(now)
        sample.position = self.places.take(sample.position)
        self._loop.board.drop()
        return sample


class Listener(HeardArm, Calibrations):
    """Context manager: `with Listener(arm, bus) as listener: sample = listener.next(0.1)`."""

    def __init__(self, arm: ArmFile, bus: "CanBus | can.BusABC") -> None:
        """Take `bus` (python-can's too, closed on leaving)."""
        self.bus = as_bus(bus)
        super().__init__(arm, self.bus)
        self._port = self.bus.open_listening_port()
        self.listen_on(self._port, self._take_unknown)
        self.ask = LinkAsk(self._loop, self.clock, self._pump)
        self.calibrate_host(simulated=self.lock_step)
        self._ready: deque[tuple[Sample, Commands]] = deque()
        self._sent: Commands = ()
        self._sample: Sample | None = None
        """The last result of `next`, and the commands for it."""
        self._decoded: tuple[Array, Array] | None = None
        self._sync: float | None = None
        self._since: float | None = None
        self._now = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.bus.shutdown()

    @property
    def stats(self) -> Stats:
        """Counters since the first SYNC heard, rate and load brought up to date; `late` stays 0."""
        if self._since is not None:
            self._loop.measure(self.clock.now() - self._since, self.section.bus.bitrate)
        return self._loop.stats

    @property
    def emergencies(self) -> deque[DriveEvent]:
        """Everything that drives told of themselves; the caller may clear it."""
        return self._loop.board.events

    @property
    def torque_sent(self) -> Array:
        """Commanded torque of the other controller for the last sample of `next` [N·m], (n,); NaN before its first.

        Of a drive with gains the torque of its law at the readings of that sample.
        """
        return self._commands[0]

    @property
    def position_sent(self) -> Array:
        """Its target position [rad], likewise."""
        return self._commands[1]

    @property
    def orders_sent(self) -> list[Order | None]:
        """Orders of the other controller for the last sample of `next`, at the joint; None for a joint without."""
        return self._host.orders(self._sent)

    @property
    def _commands(self) -> tuple[Array, Array]:
        if self._decoded is None:
            self._decoded = self._host.decode(self._sent, self._sample)
        return self._decoded

    def next(self, timeout: float) -> Sample | None:
        """The next complete sample, or None where no SYNC completes one within `timeout` [s]; raises BusFault.

        A sample is complete when the SYNC after it comes; its time is that of its own SYNC, by `clock`.
        """
        if not self._ready:
            end = self.clock.now() + timeout
            while not self._ready:
                remaining = end - self.clock.now()
                if remaining <= CLOCK_RESOLUTION:
                    return None
                self._hear(remaining)
        self._sample, self._sent = self._ready.popleft()
        self._decoded = None
        return self._sample

    def _hear(self, seconds: float, at_once: bool = False) -> None:
        """Take in what comes, for at most that long; `at_once`: somebody waits for the very next frame."""
        port = self._port
        if isinstance(port, StampedPort):
            if at_once:
                port.wait(seconds)
            else:
                self.clock.sleep_until(self.clock.now() + min(seconds, SLEEP_SECONDS))
            frames = port.take_all()
        else:
            frame = port.receive(seconds)
            frames = [] if frame is None else [(self.clock.now(), *frame)]
        self._loop.count(len(frames), sum([len(data) for _, _, data in frames]))
        take = self._loop.take
        for t, can_id, data in frames:
            self._now = t
            take(can_id, data)

    def _take_unknown(self, can_id: int, data: bytes) -> None:
        if self._host.begins(can_id, data):
            self._complete(self._now)

    def _complete(self, now: float) -> None:
        """A cycle begins: what came since the one before is its sample."""
        if self._sync is None or self._since is None:
            self._loop.reset_counters()
            self._loop.board.drop()
            self._since = now
        else:
            sample = self.take_sample(self._sync)
            sample.t = self._sync
            self._loop.stats.missed += sum([value != value for value in sample.position.tolist()])  # NaN
            self._ready.append((sample, self._host.ended))
        self._sync = now

    def _pump(self, done: Callable[[], bool], timeout: float) -> bool:
        end = self.clock.now() + timeout
        while not done():
            remaining = end - self.clock.now()
            if remaining <= 0:
                return False
            self._hear(remaining, at_once=True)
        return True
