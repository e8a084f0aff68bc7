"""The cyclic path: orders out as frames, readings in. One loop owns the port."""

import math
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from armlink.arm_file import LONGEST_DEADLINE
from armlink.arrays import Array
from armlink.bus.frame_bits import FIXED_BITS
from armlink.bus.port import BUS_SHIFT, Frame, Port
from armlink.clock import Clock
from armlink.drives.base import ANY
from armlink.drives.board import Board, DriveEvent
from armlink.drives.orders import Order, Power, Reading, law_torque, power_code
from armlink.errors import BusFault, HostLate, Refused
from armlink.link.bus_watchdog import MOST_FRAMES, OWN_RATE, BusWatch
from armlink.link.gate import ROUNDING_FACTOR
from armlink.link.joints.groups import Group, traits_of
from armlink.link.joints.values import JointValues
from armlink.link.keeper import Keeper
from armlink.link.types import Sample, Stats

COLLECT_SHARE = 0.8
"""Share of a period after the commands in which their replies are waited for."""
EARLIER_FACTOR, LATER_FACTOR = 0.998, 1.03
"""The loop sleeps until the replies should all have come, instead of waking for each: a little earlier from cycle to
cycle while they all had, later once one had not."""
LEAST_REST = 1e-4
"""Shorter rests are not worth their system call [s]."""
RECEPTION_TRIES = 16
"""A frame is asked for so often of a port that reports faults; a batch that tells of one may hold frames too."""
LATE_CYCLES = 3
"""A joint that has answered in so many cycles, and is as far behind as before, is not late: a reply was lost."""
_UNTAGGED = (1 << BUS_SHIFT) - 1


class Loop:
    """Frames of one cycle out and in, for n joints; knows no limits and judges nothing, only keeps what came."""

    def __init__(
        self, port: Port, clock: Clock, groups: Sequence[Group], values: JointValues, period: float, lock_step: bool
    ) -> None:
        """`values` turns values of drives into those of joints and back; in lock-step sending is the period itself."""
        self.groups, self.n, self.values = tuple(groups), sum([len(group.places) for group in groups]), values
        self.period = period
        self.stats = Stats()
        self.board = board = Board(self.n)
        traits = traits_of(self.groups)
        cadences = {each.cadence for each in traits}
        self.watch = BusWatch(self.n, max(1.0, OWN_RATE * period) if "cyclic" in cadences else 1.0)
        board.on_again, board.on_slow = self.watch.again, self.watch.slow
        board.readings = self.watch.readings
        self.withheld: frozenset[int] = frozenset()
        """Joints that get no command, so that their own deadline is put to the test."""
        self.verify: Callable[[int, Order], None] = lambda joint, sent: None
        """Called with what the bytes that are about to leave order a joint; raises where that is beyond a limit."""
        self.on_frame: Callable[[int, bytes], None] | None = None
        """Also gets each frame that is no reading of the fast way, while somebody waits for an answer."""
        self.on_unknown: Callable[[int, bytes], None] = lambda can_id, data: None
        """Takes frames that no drive of ours sends, such as those of another host."""
        self._port, self._clock = port, clock
        self._lock_step = lock_step
        self._patience = 0.0 if lock_step else COLLECT_SHARE * period
        self._rest = 0.0
        """Time from the commands until it looks for replies [s]."""
        self.woke = -math.inf
        """When it last began to take in replies that nobody waited for, by the clock [s]."""
        self._drained = -math.inf
        """When it last had taken in all of a cycle [s]: the watch counts the frames from there to the next time."""
        self.just_woke = False
        """Whether that was after the last commands."""
        self._alone = self.groups[0] if len(self.groups) == 1 else None
        self._pass_time: Callable[[float], None] | None = None
        if lock_step and "sync" not in cadences:
            self._pass_time = getattr(port, "pass_time", None)
        board.asked = [int(each.cadence != "cyclic") for each in traits]
        self._expected = sum(board.asked)
        self._fast: dict[int, Callable[[bytes], None]] = {}
        self._others: dict[int, Callable[[int, bytes], None]] = {}
        self._any: list[Callable[[int, bytes], None]] = []
        for group in self.groups:
            self._route(group)
        self.told: list[Order | None] = [None] * self.n
        """Orders of the newest frames by their bytes, at each joint; None where they carry no target."""
        self.keeper: Keeper | None = None
        """Told in every cycle what leaves the drives safe, should this be the last."""
        self._leaving: list[Frame] = []
        """Frames of the newest cycle, which have passed the check."""
        self._counted = self._dropped = 0
        self.bits = 0
        """Bits that the frames so far took on the wire, without stuff bits (bus_load.frame_bits has them)."""
        self._nothing = np.full(self.n, math.nan)
        self.seen = [-math.inf] * self.n
        """When position and torque of each joint last came, by the clock [s]."""
        self._first: float | None = None
        self.latest_position = [math.nan] * self.n
        """Newest position of each joint whenever it came [rad]; for the gate, never for a sample."""
        self.latest_motor_torque = [math.nan] * self.n
        """Newest motor torque of each joint whenever it came [N·m]; for the gate, never for a sample."""
        self.latest_velocity = [math.nan] * self.n
        """Newest velocity of each joint whenever it came [rad/s]; for the gate, never for a sample."""
        self.on_cycle: Callable[[], object] = lambda: None
        self.slow_seen = [-math.inf] * self.n
        """When the motor torque of each joint last came, by the clock [s]."""
        self.speed_seen = [-math.inf] * self.n
        """When the velocity of each joint last came, by the clock [s]."""
        self.synced = -math.inf
        """When the last commands left, by the clock [s]."""
        self._left, self._behind = [0] * self.n, [0] * self.n
        """Unanswered commands of each joint in the cycle before; cycles in which it has answered since it last came
        nearer to having answered all."""
        self.earliest, self.latest = [-math.inf] * self.n, [-math.inf] * self.n
        """Bounds of the time at which the newest position of each joint was taken, by the clock [s]."""
        self._asked_at: deque[float] = deque(maxlen=math.ceil(LONGEST_DEADLINE / period))
        """When the newest commands left, by the clock [s]; a joint that is silent for longer has the link stopped."""
        self._collected = self._heard_until = -math.inf
        """When the replies of this cycle and of the one before were in, by the clock [s]."""

    def _route(self, group: Group) -> None:
        drives, tag = group.drives, group.tag
        fast = drives.fill(self.board, group.places)
        self._fast |= {can_id | tag: take for can_id, take in fast.items()}
        take = partial(self._take_drive, group)
        for can_id in drives.routes():
            if can_id == ANY:
                self._any.append(take)
            elif can_id not in fast:
                self._others[can_id | tag] = take

    def reset_counters(self) -> None:
        self.stats, self.bits, self._first, self._counted = Stats(), 0, None, 0
        self.board.came, self.board.errors = [0] * self.n, 0
        self._dropped = self._port.dropped

    @property
    def dropped(self) -> int:
        """Frames that this host lost because it read too slowly, since the counters began."""
        return self._port.dropped - self._dropped

    def send(self, can_id: int, data: bytes) -> None:
        self._port.send(can_id, data)
        self.count(1, len(data))

    def receive(self, timeout: float) -> bool:
        """Take one frame in, waiting for it at most `timeout` seconds; False where none came."""
        frame = self._hear(timeout)
        if frame is None:
            return False
        self.stats.frames += 1
        self.bits += FIXED_BITS + 8 * len(frame[1])
        self.take(*frame)
        return True

    def _hear(self, timeout: float) -> Frame | None:
        """The next frame. A port that cannot receive is a fault among others: it keeps no frame from leaving."""
        for _ in range(RECEPTION_TRIES):
            try:
                return self._port.receive(timeout)
            except BusFault as fault:
                self.watch.reception, timeout = self.watch.reception or str(fault), 0.0
        return None

    def drain(self) -> None:
        """Take in all that came between cycles; replies among it are late: newest known, but of no sample."""
        board = self.board
        complete, board.awaited = self.just_woke and board.awaited <= 0, 0
        if not complete:
            self._take_what_is_there()
        now = self._clock.now()
        self._keep_late(now)
        self.watch.cycle_ends(self.stats.frames - self._counted, (now - self._drained) / self.period)
        self._counted, self._drained = self.stats.frames, now
        if board.slow_came:
            self._keep_slow(now)

    def _take_what_is_there(self) -> int:
        """Take in the frames that are there, counted all at once; how many they were."""
        receive, fast, came, size = self._hear, self._fast, 0, 0
        while came < MOST_FRAMES:
            frame = receive(0.0)
            if frame is None:
                break
            can_id, data = frame
            came, size = came + 1, size + len(data)
            take = fast.get(can_id)
            if take is not None:
                take(data)
            else:
                self.take(can_id, data)
        else:
            self.watch.flooded = True
        self.count(came, size)
        return came

    def _keep_late(self, now: float) -> None:
        """Replies that came after their cycle: as old as the last commands at least, and of no sample."""
        board, values = self.board, self.values
        for joint, raw in enumerate(board.position):
            if raw == raw and board.asked[joint]:  # not NaN
                self.latest_position[joint] = values.position_of(joint, raw)
                self._note_time(joint, now)
                self.seen[joint] = max(self.seen[joint], self.synced)
                board.position[joint] = board.sensor[joint] = math.nan

    def settle(self) -> None:
        """After an interruption: nothing is to come, nothing was lost, no node is crowding the bus."""
        self.just_woke = False
        self.drain()
        self.synced = -math.inf
        self.board.unanswered, self._left, self._behind = ([0] * self.n for _ in range(3))
        self._dropped = self._port.dropped
        self.watch.settle()

    def exchange(
        self,
        orders: Sequence[Order],
        ordered: float,
        decided: float = math.inf,
        max_age: float = math.inf,
        until: float = -math.inf,
    ) -> Sample:
        """One cycle: the frames of the orders made at `ordered` (clock), then the readings that they bring; raises as
        `verify`.

        Replies are taken in when all should have come, or at `until` (clock) if that is later. Raises HostLate, and
        sends nothing, if the frames would leave more than `max_age` [s] after `decided` (clock).
        """
        board = self.board
        frames = self._encode(orders, ordered)
        now = self._clock.now()
        if now - decided > max_age:
            raise HostLate(now - decided, max_age, "the command became too old before its frames were sent")
        if self._first is None:
            self._first = now
        if self.keeper is not None:
            self.keeper.renew(self._safe_frames())
        board.awaited = self._expected
        board.ask()
        self.watch.syncs += 1
        self.stats.asked += 1
        send = self._port.send
        for can_id, data in frames:
            send(can_id, data)
        self.count(len(frames), sum([len(data) for _, data in frames]))
        if self._pass_time is not None:
            self._pass_time(self.period)
        self.synced, self.just_woke = now, False
        self._asked_at.append(now)
        delay = self._collect(now, until)
        self._heard_until, self._collected = self._collected, now if self._lock_step else now + delay
        self.stats.missed += board.awaited
        timely = self._timely()
        sample = self.sample(now)
        sample.timely, sample.delay = timely, delay
        self.on_cycle()
        return sample

    def _collect(self, now: float, until: float) -> float:
        """Take in the replies to commands that left at `now`; how long they took [s], or what was waited for them."""
        board, clock, patience = self.board, self._clock, self._patience
        rested = self._rest
        if unhurried := until > now + rested:
            clock.sleep_until(until)
            self.woke, self.just_woke = clock.now(), True
        elif board.awaited > 0 and rested >= LEAST_REST:
            clock.sleep_until(now + rested)
        self._take_what_is_there()
        delay = clock.now() - now
        if unhurried:
            return delay
        if board.awaited <= 0:
            self._rest = EARLIER_FACTOR * rested
            return delay
        while board.awaited > 0 and delay < patience and not self.watch.flooded:
            in_time = self.receive(patience - delay)
            self._take_what_is_there()
            delay = clock.now() - now
            if not in_time:
                break
        self._rest = min(max(LATER_FACTOR * rested, LEAST_REST), LATER_FACTOR * delay, patience)
        return delay

    def _encode(self, orders: Sequence[Order], now: float) -> list[Frame]:
        """Frames of the orders, every group's; what their bytes say is checked before they may leave."""
        group = self._alone
        if group is not None and self.values.plain and not self.withheld:
            frames = group.drives.frames(orders, now)
        else:
            frames = []
            driven = [None if j in self.withheld else self.values.order(j, order) for j, order in enumerate(orders)]
            for each in self.groups:
                own = each.drives.frames([driven[place] for place in each.places], now)
                frames += [(can_id | each.tag, data) for can_id, data in own] if each.tag else own
        if frames != self._leaving or any(order.kp for order in orders):  # with gains the joint's place counts too
            self._leaving = []
            for each in self.groups:
                sent_of = each.drives.sent
                for joint, place in enumerate(each.places):
                    sent = sent_of(joint)
                    if sent is not None:
                        sent = self.values.ordered(place, sent)
                        self.verify(place, sent)
                    self.told[place] = sent
            self._leaving = frames
        return frames

    def _safe_frames(self) -> list[Frame]:
        """Of drives that keep on with their last command. Raises Refused where their bytes order more than a limit
        of the drive, by its newest readings."""
        found = list[Frame]()
        for group in self.groups:
            drives = group.drives
            for joint in range(len(group.places)):
                keeps_on = drives.traits(joint).silence == "keeps on"
                for can_id, data in drives.safe_frames(joint) if keeps_on else ():
                    for _, order in drives.commands_of(can_id, data):
                        known, limits = drives.memory[joint], drives.limits_of(joint)
                        torque = law_torque(order, known.position, known.velocity)
                        inside = limits.lower <= order.position <= limits.upper or not order.kp > 0
                        within = inside and abs(torque) <= ROUNDING_FACTOR * limits.max_torque
                        if order.power is Power.ON and not within:
                            raise Refused(f"keeper: the frame to {drives.where(joint)} exceeds a limit")
                    found.append((can_id | group.tag, data))
        return found

    def _timely(self) -> NDArray[np.bool_] | None:
        """Which readings are replies to this cycle's commands; None: all. Of a joint that answers for long and does not
        catch up, a reply was lost."""
        board = self.board
        unanswered, before, behind = board.unanswered, self._left, self._behind
        self._left = unanswered.copy()
        if not any(unanswered):
            return None
        came = [raw == raw for raw in board.position]
        timely = np.array([here and not left for here, left in zip(came, unanswered, strict=True)])
        for joint, here in enumerate(came):
            left = unanswered[joint]
            behind[joint] = behind[joint] + here if left >= before[joint] > 0 else 0
            if behind[joint] >= LATE_CYCLES:
                unanswered[joint] = self._left[joint] = behind[joint] = 0
        return timely

    def listen(self, seconds: float) -> Sample:
        """Take in what comes within `seconds` without sending anything; of each reading the newest."""
        self.drain()
        end = self._clock.now() + seconds
        while (remaining := end - self._clock.now()) > 0:
            self.receive(remaining)
        return self.sample(self._clock.now())

    def measure(self, elapsed: float, bitrate: int) -> None:
        """Bring rate and load of the stats up to date for `elapsed` seconds."""
        if elapsed > 0:
            self.stats.rate_hz = self.stats.cycles / elapsed
            self.stats.load = self.bits / (bitrate * elapsed)
        self.stats.came = tuple(self.board.came)

    def take(self, can_id: int, data: bytes) -> None:
        """Take one frame in, for what it is; who takes it counts it."""
        fast = self._fast.get(can_id)
        if fast is not None:
            fast(data)
            return
        take = self._others.get(can_id)
        others = self.watch.others
        others[can_id] = others.get(can_id, 0) + 1
        if take is not None:
            take(can_id, data)
            return
        if not self.watch.intruder and not (self.keeper is not None and self.keeper.sends((can_id, data))):
            self._suspect(can_id, data)
        self.watch.strangers += 1
        for take in self._any:
            take(can_id, data)
        self.on_unknown(can_id, data)

    def _suspect(self, can_id: int, data: bytes) -> None:
        """Whether a frame that no drive of ours sends is another host's."""
        for group in self.groups:
            if can_id & ~_UNTAGGED == group.tag and (what := group.drives.intrusion(can_id & _UNTAGGED, data)):
                self.watch.intruder = f"{what} ({can_id & 0x1FFFFFFF:03X}h)"
                return

    def count(self, frames: int, size: int) -> None:
        """Count frames that went over the bus, with this many bytes of data in all."""
        self.stats.frames += frames
        self.bits += FIXED_BITS * frames + 8 * size

    def _take_drive(self, group: Group, can_id: int, data: bytes) -> None:
        if self.on_frame is not None:
            self.on_frame(can_id, data)
        if can_id & ~_UNTAGGED != group.tag:
            return
        reading = group.drives.take(can_id & _UNTAGGED, data, self._clock.now())
        if reading is not None:
            self._keep_reading(group.places[reading.joint], reading)

    def _keep_reading(self, joint: int, reading: Reading) -> None:
        board = self.board
        _, position, velocity, motor, sensor, _, power, fault = reading
        if position == position:  # not NaN
            board.reading(joint, position, sensor)
        elif motor == motor:
            self.watch.torque_alone(joint)
        if motor == motor:
            board.motor[joint], board.slow_came = motor, True
        if velocity == velocity:
            board.velocity[joint], board.slow_came = velocity, True
        if power is not None:
            board.status[joint] = power_code(power)
        if fault:
            event = DriveEvent(joint, "", fault)
            if not board.events or board.events[-1] != event:
                board.events.append(event)

    def sample(self, now: float) -> Sample:
        """Readings since the last sample, the newest of each, as of time `now`; NaN if there was none."""
        board, values = self.board, self.values
        position = values.position(np.array(board.position))
        if board.slow_came:
            motor, velocity = self._keep_slow(now)
            board.motor, board.velocity = [math.nan] * self.n, [math.nan] * self.n
            board.slow_came = False
        else:
            motor, velocity = self._nothing.copy(), self._nothing.copy()
        torque = values.torque(np.array(board.sensor), motor)
        board.drop()
        for joint in self._keep(position, self.latest_position):
            self.seen[joint] = now
            self._note_time(joint, self._collected)
        self.stats.cycles += 1
        self.stats.errors = board.errors
        status: NDArray[np.int64] = np.array(board.status, np.int64)
        age: Array = now - np.array(self.seen)
        return Sample(now - (self._first or 0.0), position, velocity, torque, motor, status, age)

    def _note_time(self, joint: int, latest: float) -> None:
        """When the newest position of a joint was taken: before `latest` [s], and no earlier than the command left to
        which it is the reply; of a drive that sends by its own clock, than the readings before had been taken in."""
        asked, back = self._asked_at, self.board.answered[joint]
        earliest = asked[-min(max(back, 1), len(asked))] if asked else -math.inf
        self.earliest[joint] = earliest if self.board.asked[joint] or self._lock_step else self._heard_until
        self.latest[joint] = latest

    def _keep_slow(self, now: float) -> tuple[Array, Array]:
        """Motor torque and velocity that came, also kept as the newest known."""
        motor = self.values.motor(np.array(self.board.motor))
        velocity = self.values.velocity(np.array(self.board.velocity))
        for joint in self._keep(motor, self.latest_motor_torque):
            self.slow_seen[joint] = now
        for joint in self._keep(velocity, self.latest_velocity):
            self.speed_seen[joint] = now
        return motor, velocity

    def _keep(self, values: Array, latest: list[float]) -> list[int]:
        """Put the values that came into `latest`; the joints that they came from."""
        came = []
        for joint, value in enumerate(values.tolist()):
            if value == value:  # not NaN
                latest[joint] = value
                came.append(joint)
        return came
