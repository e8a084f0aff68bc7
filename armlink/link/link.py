"""The link: an arm's joint controllers on a CAN bus; samples in SI units out, limited commands in."""

import contextlib
import logging
import math
from collections.abc import Callable
from dataclasses import replace
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Self, TypeVar

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.bus.adapters import as_bus
from armlink.bus.arm_hold import ArmHold
from armlink.bus.can_bus import CanBus
from armlink.bus.listening.joint_messages import ListeningBus
from armlink.clock import Clock, MonotonicClock
from armlink.drives.orders import DriveIdentity, Order, Power, Setup, law_torque
from armlink.errors import BadInput, BusFault, HostLate, Silence
from armlink.link.bus_load import overload
from armlink.link.bus_watchdog import MOST_FRAMES
from armlink.link.cycle import Commander
from armlink.link.cyclic_exchange import Loop
from armlink.link.ends import EndCause, cause_of, end_work
from armlink.link.faults import bus_fault
from armlink.link.gate import JointLimits, start_order
from armlink.link.gate_limits import arm_limits, gate_limits, joint_ranges, require_ranges
from armlink.link.joints.ask import LinkAsk
from armlink.link.joints.calibrations import Calibrations
from armlink.link.joints.groups import Group, by_joint, make_groups, traits_of
from armlink.link.joints.values import values_of
from armlink.link.joints.whole_turns import WholeTurns, positions_before_power
from armlink.link.keeper import Keeper
from armlink.link.park import falling_joints, park, require_deadman
from armlink.link.reading_bounds import Crossed
from armlink.link.types import Command, Controller, Sample, Samples, Setpoints, Stats, Tell
from armlink.termination import Presses, end_logger

if TYPE_CHECKING:
    import can

log = logging.getLogger("armlink")
READING_AGE_PERIODS = 2.5
"""Readings may be this many periods old while a motion goes on; a reply that comes a period late is within it."""
LISTEN_PERIODS, LISTEN_SECONDS = 2, 0.1
"""Another host is listened for before anything is sent to the nodes: this many periods, and at least this long [s],
since a host on a busy computer may pause for some 0.05 s."""
BACKLOG_TRIES = 5
"""So often all frames that are there are taken in before the start: drives that send by their own clock go on while a
busy computer has not read them yet."""
ANSWER_SECONDS = 5.0
"""After a stall a controller may take so long to answer [s]."""
R = TypeVar("R")
P = ParamSpec("P")


class Link(Calibrations):
    """Context manager: `with Link.open(arm) as link: link.start(); link.enable(); link.cycle(command)`.

    Leaving it, however, brings the arm to its end as `armlink.link.ends` has it: joints whose drives hold stay in quick
    stop; an arm that would fall is parked, or let down, and only then loses its power.
    """

    def __init__(
        self,
        arm: ArmFile,
        bus: "CanBus | can.BusABC",
        clock: Clock | None = None,
        overloaded: str = "",
        spec: str | None = None,
    ) -> None:
        """Take `bus` (python-can's too, closed on leaving) and a clock: by default the bus's own or the machine's.

        `overloaded` says why frames come late or never, on a bus that cannot carry the cycle (`overload`). `spec` names
        the bus for a keeper, which opens it too; None: the arm file's.
        """
        self.arm, self.bus = arm, as_bus(bus)
        if isinstance(self.bus, ListeningBus):
            self.bus.shutdown()
            raise BadInput(
                f"bus {self.bus.channel_info}: this bus is listen-only, but this command needs the drives: use "
                "record, monitor, observe, or daemon --listen-only"
            )
        self.section = section = arm.require_link()
        self.names = tuple(joint.name for joint in section.joints)
        self.n, self.rate, self.period = len(self.names), section.rate, 1.0 / section.rate
        self._lock_step = self.bus.clock is not None
        self.clock: Clock = clock or self.bus.clock or MonotonicClock()
        stops = joint_ranges(arm)
        self.limits = arm_limits(section, stops)
        """The arm file's limits of every joint."""
        self.groups: tuple[Group, ...] = make_groups(arm, self.bus)
        """The drives by family and bus."""
        self.values = values_of(arm, self.groups)
        self.turns = WholeTurns(arm, self.values, stops)
        """Tells which joints cannot stand where they read, and corrects zeros."""
        self._loop = Loop(self.bus.open_port(), self.clock, self.groups, self.values, self.period, self._lock_step)
        self.commander = Commander(self._loop, self.clock, self.names, self.period, section.deadline, self._lock_step)
        self.ask = LinkAsk(self._loop, self.clock, self._pump)
        """Requests to drives, outside of cycles or between them."""
        self.calibrate_host(simulated=self._lock_step)
        self.setups: list[Setup] = []
        """Results of start(), in joint order."""
        self._cycling = self._enabled = self._held = False
        self._since = 0.0
        self.position_step = np.full(self.n, np.inf)
        """Smallest change that each position reading can show (n,) [rad]; inf before start()."""
        self.last: Command | None = None
        self._hold: ArmHold | None = None
        self._overloaded, self._spec = overloaded, spec
        self.tell: Tell = lambda text: log.debug("%s: %s", self.arm.name, text)
        """Told what start() does with an arm that is out."""

    @classmethod
    def open(cls, arm: ArmFile, bus: str | None = None) -> "Link":
        """Open the bus `INTERFACE:CHANNEL[@BITRATE]`, by default the arm file's; raises BadInput or BusFault."""
        from armlink.bus.open import open_link_bus

        return cls(arm, open_link_bus(bus, arm.require_link()), overloaded=overload(arm, bus), spec=bus)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close(cause_of(error))

    def close(self, cause: EndCause = EndCause.DONE, tell: Tell | None = None) -> None:
        """Bring the arm to its end (`armlink.link.ends`), and close the bus; `tell` is told what is being done.

        Ctrl-C no longer raises meanwhile; pressed twice it lets the arm go.
        """
        try:
            if tell is not None:
                end_work(self, cause, tell)
                return
            level = logging.INFO if self._lock_step else logging.WARNING
            with Presses() as presses:
                end_work(self, cause, end_logger(self.arm.name, presses, level))
        finally:
            if self._loop.keeper is not None:
                self._loop.keeper.close()
            self.bus.shutdown()
            if self._hold is not None:
                self._hold.release()

    @property
    def enabled(self) -> bool:
        """Whether the joints are enabled and cycles must go on."""
        return self._enabled

    @property
    def held(self) -> bool:
        """Whether the joints were stopped and have to be held by cycles of `keep`, since their drives would let go."""
        return self._held

    @property
    def falls(self) -> bool:
        """Whether some drive lets go, or sinks, when its host falls silent."""
        return bool(falling_joints(self))

    @property
    def addresses(self) -> list[tuple[str, str]]:
        """Bus, by its name in the arm file, and id of each joint's drive."""
        return [(joint.bus, joint.settings.address) for joint in self.section.joints]

    @property
    def latest_position(self) -> Array:
        """Newest position readings, whenever they came (n,) [rad]."""
        return np.array(self._loop.latest_position)

    @property
    def stats(self) -> Stats:
        """Counters since the first cycle, rate and load brought up to date."""
        if self._cycling:
            self._loop.measure(self.clock.now() - self._since, self.section.bus.bitrate)
        return self._loop.stats

    @property
    def torque_sent(self) -> Array:
        """Torque that the last frames command [N·m], (n,); of a drive with gains by its law, at the newest readings."""
        return self.sent[0]

    @property
    def position_sent(self) -> Array:
        """Target position of the last frames [rad], (n,)."""
        return self.sent[1]

    @property
    def sent(self) -> tuple[Array, Array]:
        """`torque_sent` and `position_sent`, the bytes decoded once."""
        orders = self.orders_sent
        readings = zip(orders, self._loop.latest_position, self._loop.latest_velocity, strict=False)
        return np.array([law_torque(*each) for each in readings]), np.array([order.position for order in orders])

    @property
    def orders_sent(self) -> list[Order]:
        """Orders as their bytes tell them; as they passed where the bytes carry no target."""
        pairs = zip(self._loop.told, self.commander.passed, strict=False)  # nothing has passed before start()
        return [passed if told is None else told for told, passed in pairs]

    def scan(self) -> list[DriveIdentity]:
        """Identity and state of each joint's drive; one that does not answer is there with `present` false."""
        found = {
            group.places[each.joint]: replace(each, joint=group.places[each.joint])
            for group in self.groups
            for each in group.drives.identify(self._ask(group))
        }
        return [found[joint] for joint in range(self.n)]

    def start(self, to_enable: bool = True) -> None:
        """Check the drives, set them up with the device's own limits, start them.

        The set-up takes their power: an arm that would fall is brought to its end first. Raises Refused for another
        controller than the arm file states, and for a joint that cannot stand where it reads, unless nothing is
        `to_enable`; BusFault, BadInput.
        """
        if self.falls:
            end_work(self, EndCause.DONE, self.tell)
        self._hold = self._hold or ArmHold(self.bus, self.addresses)
        missing = [
            f"{self.names[group.places[joint]]} ({self.section.joints[group.places[joint]].settings.address})"
            for group in self.groups
            if group.drives.missing(self._ask(group))
            for joint in group.drives.missing(self._ask(group))  # a busy one is asked twice
        ]
        if missing:
            channel = self.bus.channel_info
            raise BusFault(
                f"no answer from {', '.join(missing)} on {channel}: check power and wiring, and the ids in the arm file"
            )
        if self._overloaded:
            log.warning("%s: %s", self.arm.name, self._overloaded)
        self.require_alone()
        self._set_up()
        if to_enable:
            self.turns.require(self.set_up_positions)
        loop = self._loop
        loop.drain()
        self._alone()
        for group in self.groups:
            group.drives.forget()
        loop.reset_counters()
        self._since = self.clock.now()
        self._cycling = True

    def require_alone(self) -> None:
        """Listen before anything is set; raises BusFault where another host is on the bus."""
        for _ in range(BACKLOG_TRIES):
            self._loop.watch.clear()
            self._loop.drain()
            if not self._loop.watch.flooded:
                break
        self._loop.watch.clear()
        for group in self.groups:
            group.drives.forget(restarts=True)
        if not self._lock_step:
            self._loop.listen(max(LISTEN_PERIODS * self.period, LISTEN_SECONDS))
        self._alone()

    def _alone(self) -> None:
        """Raise BusFault where another host was heard or a controller has restarted."""
        for name, (group, number) in zip(self.names, by_joint(self.groups), strict=True):
            if group.drives.has_restarted(number):
                raise BusFault(f"{name}: its drive has just restarted (boot-up message): repeat the command")
        self.require_sound_bus()

    def require_sound_bus(self) -> None:
        """Raise BusFault where the bus itself has a fault, such as a second host."""
        fault = bus_fault(self.names, self._loop.watch, 0)
        if fault:
            raise BusFault(fault)

    def _set_up(self) -> None:
        """Set every drive up; what the first cycle starts from."""
        self.correct_turns()
        found: dict[int, Setup] = {}
        for group in self.groups:
            own = [self.values.limits(place, self.limits[place]) for place in group.places]
            found |= dict(zip(group.places, group.drives.set_up(self._ask(group), own), strict=True))
        self.setups = [found[joint] for joint in range(self.n)]
        self.position_step = np.array([each.position_step for each in self.setups]) / self.values.gear
        passed = []
        limits = [self._gate_limits(joint) for joint in range(self.n)]
        for joint, (setup, limit) in enumerate(zip(self.setups, limits, strict=True)):
            at_drive = self.values.limits(joint, self.limits[joint])
            ends = (at_drive.lower, at_drive.upper)
            require_ranges(self.names[joint], setup.ranges, limit, self.section.joints[joint], ends)
            torque = self.values.torque_of(joint, setup.torque)
            passed.append(start_order(limit, torque, self.values.position_of(joint, setup.position)))
        self.commander.begin(limits, passed, [each.modes for each in self.setups], self.position_step)

    @property
    def set_up_positions(self) -> Array:
        """Position of each joint as its set-up found it (n,) [rad]."""
        return self.values.position(np.array([each.position for each in self.setups]))

    def read_positions(self) -> Array:
        """Position of each joint as its drive tells it without being set up (n,) [rad]; NaN where it does not."""
        raw = np.full(self.n, np.nan)
        for group in self.groups:
            raw[list(group.places)] = group.drives.positions(self._ask(group))
        return self.values.position(raw)

    def correct_turns(self) -> None:
        """Correct zeros by whole turns where the arm file has `turns: auto`, before limits are set in the drives."""
        if self.turns.any_automatic and self.turns.correct(self.read_positions()):
            self._loop.latest_position = [math.nan] * self.n  # by zeros of before

    def guard_rules(self) -> dict[str, Any]:
        """Frames that a guard of the bus may pass to these drives, as `armlink.guard.bus_guard` takes it; sets nothing.

        Raises BusFault where a drive does not answer, BadInput for drives that no guard can check.
        """
        rules: dict[str, Any] = {"frames": {}, "stop": [], "restarts": {}}
        watches = {"deadline": self.section.deadline, "fd": self.section.bus.fd}
        self.correct_turns()
        for group in self.groups:
            if group.tag:
                name = self.names[group.places[0]]
                raise BadInput(
                    f"{name} is on another bus than the first joint, but a guard checks one bus only: write one arm "
                    "file for each bus"
                )
            own = [self.values.limits(place, self.limits[place]) for place in group.places]
            found = group.drives.guard_rules(self._ask(group), own)
            rules["frames"] |= found["frames"]
            rules["stop"] += found["stop"]
            rules["restarts"] |= found["restarts"]
        return rules | watches

    def _gate_limits(self, joint: int) -> JointLimits:
        limits = self.limits[joint]
        gains = self.values.gains(joint, self.setups[joint].gains)
        return gate_limits(limits, gains, self.values.reach(joint, limits.max_torque))

    def calibration_changed(self, joint: int) -> None:
        """The gate's limits follow the host's calibration."""
        if self.setups:
            self.commander.limits[joint] = self._gate_limits(joint)

    def enable(self) -> Sample:
        """Walk every joint to ON, under position control where it stands, and return the last sample.

        Faults are reset on the way. Raises Refused for drives that nothing stops when this host dies, BusFault naming
        the joint and the state it stays in.
        """
        self._require_start()
        require_deadman(self)
        self._start_keeper()
        self._forget()
        self.commander.settle()
        self.turns.require(positions_before_power(self.commander, self.set_up_positions.tolist(), self._since))
        self._held = self.falls  # what has power by now is not dropped by whatever ends the walk
        try:
            sample = self.commander.walk(Power.ON)
        except BusFault as fault:
            self._held = self.falls and Power.ON in self.commander.powers
            self._mind_overload(fault)
            raise
        self._forget()
        self._enabled, self._held = True, False
        self.last = Command.hold(np.array(self._loop.latest_position))
        return sample

    def _start_keeper(self) -> None:
        """Have a process watch this one, where drives would keep on with their last command; raises Refused.

        A simulated arm inside this process ends with it.
        """
        loop = self._loop
        if self._lock_step or not self.section.keeper or not any(each.kept for each in traits_of(self.groups)):
            return
        if loop.keeper is None or loop.keeper.lost:
            loop.keeper = Keeper(self.section, self._spec)

    def recover(self) -> Sample:
        """After a Stall: bring drives back that left the communication, and enable every joint where it stands."""
        self._require_start()
        self._await_answers()
        for group in self.groups:
            group.drives.recover(self._ask(group))
        return self.enable()

    def _await_answers(self) -> None:
        """Wait until every drive has answered what it was sent before; raises Silence.

        One that stood still works off what has piled up, and its replies show it as it was before it was stopped.
        """
        end = self.clock.now() + ANSWER_SECONDS
        for group in self.groups:
            while missing := group.drives.missing(self._ask(group)):
                if self.clock.now() > end:
                    name = self.names[group.places[missing[0]]]
                    raise Silence(f"{name}: no answer for {ANSWER_SECONDS:g} s")

    def _forget(self) -> None:
        self._loop.board.events.clear()
        for group in self.groups:
            group.drives.forget()

    def park(self) -> None:
        """Stow the arm in the pose `link.park` of its file and take the power from every joint there.

        Raises BadInput where the file has none, Refused where a joint is blocked (the joints then hold), BusFault.
        """
        park(self, lambda text: None)

    def disable(self) -> None:
        """Take the power from every joint: a joint without a brake falls. Raises BusFault."""
        self._require_start()
        self._enabled = self._held = False
        self.commander.walk(Power.OFF)

    def _require_start(self) -> None:
        if not self._cycling:
            raise BusFault("the nodes are not started: call start() first")

    def cycle(self, command: Command) -> Sample:
        """One cycle: wait for its time, gate, frames out, readings in.

        Raises Refused where the gate refuses the command, BusFault for a fault of bus or joint; the joints have been
        stopped before either is raised (see `stop`). Raises Crossed if a joint crossed a bound of the command's guard:
        the joints then keep the command until the next.
        """
        if not self._enabled:
            raise BusFault("the joints are not enabled: call start() and enable() before cycle()")
        self.last = command
        try:
            sample = self.commander.command(command)
        except BaseException as error:
            self.stop()
            self._mind_overload(error)
            raise
        if command.guard is not None:
            try:
                command.guard.check(self.names, self.latest_position, command.position)
            except Crossed as crossed:
                crossed.sample = sample
                raise
        return sample

    def _mind_overload(self, error: BaseException) -> None:
        """Raise for a bus that cannot carry the cycle, which no drive is to blame for."""
        if self._overloaded and isinstance(error, BusFault) and not isinstance(error, HostLate):
            error.args = (f"{error}; {self._overloaded}",)

    def play(self, setpoints: Setpoints) -> Samples:
        """One row a cycle, and the sample of each; raises as cycle. To stop early, close the iterator.

        While readings are late the row is repeated, so that the motion waits for the arm.
        """
        patience = READING_AGE_PERIODS * self.period
        for row in range(len(setpoints)):
            command = setpoints.command(row)
            sample = self.cycle(command)
            yield sample
            while not self._lock_step and max(sample.age.tolist()) > patience:
                sample = self.cycle(command)

    def run(self, controller: Controller) -> Samples:
        """A controller in the loop, cycle by cycle, until the iterator is closed; raises as cycle."""
        sample = self.cycle(self.last or Command.hold(self.position_sent))
        while True:
            sample = self.cycle(controller.command(sample))
            yield sample

    def catch_up(self) -> None:
        """Forget samples of the past: in process there are none."""

    def stop(self) -> None:
        """Stop every joint, as far as the bus still carries it: by quick stop, in which drives hold.

        Where drives would let go, the host holds the joints (`held`): it makes cycles of `keep` until they are enabled
        again or the arm comes to its end.
        """
        if not self._enabled:
            return
        self._enabled = False
        if not self.falls:
            self.commander.stop()
            return
        self._held = True
        with contextlib.suppress(BusFault):
            self.keep()

    def keep(self, goal: Array | None = None) -> Sample:
        """One cycle that holds every joint that can be held, or leads it towards `goal` (n,) [rad].

        Raises BusFault where nothing can be sent, and nothing for the fault of a joint.
        """
        sample = self.commander.keep(goal)
        self.last = Command.hold(np.array([order.position for order in self.commander.passed]))
        return sample

    def let_go(self) -> None:
        """Stop every joint and hold none: where drives let go, the arm falls."""
        self._enabled = self._held = False
        self.commander.stop()

    def inside(
        self, function: "Callable[Concatenate[Link, Tell, P], R]", tell: Tell, *args: P.args, **kw: P.kwargs
    ) -> R:
        """Call `function(link, tell, ...)` in the process that makes the cycles, which is this one."""
        return function(self, tell, *args, **kw)

    def _pump(self, done: Callable[[], bool], timeout: float) -> bool:
        """Run the loop until `done` or the time is over; enabled joints get their last command in every cycle."""
        end = self.clock.now() + timeout
        taken = 0
        while not done():
            remaining = end - self.clock.now()
            if remaining <= 0:
                return False
            if taken < MOST_FRAMES and self._loop.receive(0.0):
                taken += 1
                continue
            taken = 0  # a bus that never falls silent must not keep the joints waiting for their commands
            if self._enabled and self.last is not None:
                self.cycle(replace(self.last, t=None))
            elif self._held:
                self.keep()
            elif not self._loop.receive(remaining):
                if self._loop.watch.reception:
                    raise BusFault(self._loop.watch.reception)
                return False
        return True
