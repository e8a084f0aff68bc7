"""One cycle of the link: wait for its time, gate, frames, readings, faults; the ways into and out of power."""

import contextlib
import math
from collections.abc import Sequence

import numpy as np

from armlink.arrays import Array
from armlink.clock import Clock
from armlink.drives.orders import Mode, Order, Power, law_torque
from armlink.errors import BusFault, HostLate, Refused, Silence
from armlink.link.bus_watchdog import SLOW_CYCLES
from armlink.link.cyclic_exchange import Loop
from armlink.link.faults import bus_fault, refusal, silence
from armlink.link.gate import (
    CONTRADICTION,
    EASE_SECONDS,
    FOLLOWING,
    TORQUE_MODES,
    Corroboration,
    JointLimits,
    Seen,
    describe_excess,
    hold_order,
    is_fresh,
    pass_gate,
    start_order,
)
from armlink.link.integral import Integral
from armlink.link.joints.groups import by_joint
from armlink.link.motion_watchdog import MotionWatch
from armlink.link.types import Command, Sample

ENABLE_SECONDS = 3.0
"""The joints must reach a commanded power state within this time."""
STOP_CYCLES = 25
"""Cycles in which a stop is repeated until every joint reports it."""
LATENESS_MEMORY = 1.0
"""So long after the host was late, joints that stop by themselves are put down to it [s]: their watches run on the
heartbeat too, which they may miss for twice `link.deadline`."""
BLAME_SHARE = 0.5
"""A host that was late by this share of `link.deadline` explains a watchdog that acts at the whole of it."""
BELIEVED_DISTANCE = 0.1
"""A reading this near to where its joint was led last is believed again [rad]."""
LEAD_SHARE = 0.05
"""Of the newest cycle in the mean time from a wake to its frames."""
OFF, POSITION = int(Mode.OFF), int(Mode.POSITION)


class Commander:
    """Turns commands into orders for n joints, through the gate and nothing else, and readings into faults."""

    def __init__(
        self, loop: Loop, clock: Clock, names: tuple[str, ...], period: float, max_age: float, lock_step: bool
    ) -> None:
        """`max_age` is the oldest command and reading that count [s]; in lock-step a cycle is the period itself."""
        self.names, self.n, self.clock, self.period, self.max_age = names, len(names), clock, period, max_age
        self.limits: list[JointLimits] = []
        self.passed: list[Order] = []
        """Orders of the last frames."""
        self.loop, self._lock_step = loop, lock_step
        loop.verify = self._verify
        self._drives = tuple((group.drives, number) for group, number in by_joint(loop.groups))
        """Each joint's drive: the drives of its family, and its number among them."""
        self._slow_age = max_age + SLOW_CYCLES * period
        self._modes_of: list[frozenset[int]] = [frozenset()] * self.n
        self._commanded = [OFF] * self.n
        self._believed: dict[int, float] = {}
        """Places of joints whose readings are not believed [rad]; NaN where only those readings told it."""
        self._torque_cycles = [0] * self.n
        """Cycles that each joint has been under torque control, this one included."""
        self._integrals: list[Integral | None] = [None] * self.n
        self._with_gains = False
        self._caught: set[int] = set()
        """Joints that are being switched on again after their drives stopped by themselves."""
        self._mute_cycles = 0
        """Cycles of `keep` in a row in which nothing could be sent."""
        self.motion = MotionWatch(self.n, period)
        """Bounds of the joints' speeds by their readings."""
        self._seen_now: list[Seen] = []
        self._due = 0.0
        self.unhurried = False
        """Whether nobody waits for the sample: replies are then taken in just before the next cycle, with one wake."""
        self._lead = 0.0
        """Time from that wake to the next frames, of late [s]."""
        self.late = 0.0
        """How late the present cycle began [s]."""
        self._gap, self._gap_at = 0.0, -math.inf
        """Longest time without commands of late, less a period, and when it ended [s]."""

    def begin(
        self, limits: list[JointLimits], passed: list[Order], modes: list[frozenset[int]], position_step: Array
    ) -> None:
        """Take over drives that are set up: limits, what the first cycle starts from, modes that each has, and the
        resolution of their positions (n,) [rad]."""
        self.limits, self.passed, self._modes_of = limits, passed, modes
        self._integrals = [Integral() if each.kp else None for each in limits]
        self._with_gains = any(each is not None for each in self._integrals)
        self.motion.use(position_step, np.array([each.position_step / self.period for each in limits]))
        self._due = self.clock.now()

    def command(self, command: Command) -> Sample:
        """One cycle of a command; raises Refused where the gate refuses it, BusFault for a fault."""
        modes, torques, positions = self._numbers(command)
        passed, now = self.passed, self._await_turn()
        age = 0.0 if command.t is None else now - command.t
        fault = self._fault(now, self._commanded)
        self._seen_now = seen = self._seen(now, fault is None)
        self._torque_cycles = [
            0 if mode not in TORQUE_MODES else count + 1 if held.mode in TORQUE_MODES else 1
            for mode, count, held in zip(modes, self._torque_cycles, passed, strict=True)
        ]
        others = self._others()
        if self._with_gains:
            self._integrate(modes, torques, seen)
        refused = False
        for joint, mode in enumerate(modes):
            limits, held = self.limits[joint], passed[joint]
            order = pass_gate(limits, mode, torques[joint], positions[joint], age, held, seen[joint], others[joint])
            passed[joint] = order
            if order.refused:
                refused = True
                self._doubt(joint, order.refused, held)
        if refused:
            self._hold_the_others(seen, others)
        self._commanded, sent = modes, self.loop.synced
        if self.loop.just_woke:
            self._lead += LEAD_SHARE * (min(now - self.loop.woke, self.period / 4) - self._lead)
        until = self._due - self._lead if self.unhurried and not self._lock_step else -math.inf
        sample = self.loop.exchange(passed, now, math.inf if refused else now - age, self.max_age, until)
        sample.late = self.late
        if not self._lock_step:  # this process may have stood still at any line
            self._note_gap(self.loop.synced - sent, self.loop.synced)
            self._note_gap(sample.delay, now)
        why = refused and refusal(self.names, command, age, passed, seen, self.limits, others)
        if why:
            raise Refused(f"gate: {why}")
        fault = fault or self._fault(now, modes)
        if fault:
            raise fault
        return sample

    def _hold_the_others(self, seen: list[Seen], others: list[Corroboration]) -> None:
        """In the cycle of a refusal: joints under torque control whose drives let go are held where they stand. Their
        torques suited the motion of the joint that brakes now, and would throw them."""
        for joint, order in enumerate(self.passed):
            drives, drive = self._drives[joint]
            if order.mode in TORQUE_MODES and not order.refused and drives.traits(drive).silence != "holds":
                self.passed[joint] = self._kept(joint, seen[joint], others[joint], None) or order

    def _integrate(self, modes: list[int], torques: list[float], seen: list[Seen]) -> None:
        """Feed-forward of joints whose drives have no integral term, in place of their target torque."""
        for joint, integral in enumerate(self._integrals):
            if integral is not None:
                limits, mode = self.limits[joint], modes[joint]
                passed = self.passed[joint]
                torque = integral.update(limits, mode, passed.position, passed.velocity, seen[joint])
                if mode == POSITION:
                    torques[joint] = torque

    def stand(self, power: Sequence[Power], walk: bool = False) -> Sample:
        """A cycle that commands no motion: power states; targets as the joints stand and pull now.

        A joint that is ON keeps the target position that it has: one that followed the reading would sag.
        """
        loop, now = self.loop, self._await_turn()
        self._seen_now = seen = self._seen(now, True)
        for joint, (now_power, wanted) in enumerate(zip(self.powers, power, strict=True)):
            limits, position, on = self.limits[joint], loop.latest_position[joint], now_power is Power.ON
            if on or not math.isfinite(position):
                position = self.passed[joint].position
            integral = self._integrals[joint]
            if integral is None:
                order = start_order(limits, loop.latest_motor_torque[joint], position)
            else:
                torque = 0.0
                if on:
                    torque = integral.update(limits, POSITION, position, 0.0, seen[joint])
                else:
                    integral.reset()
                order = hold_order(limits, torque, position, seen[joint])
            mode = POSITION if on or walk or wanted is Power.ON else OFF
            self.passed[joint] = order._replace(power=wanted, walk=walk, mode=mode)
        return loop.exchange(self.passed, now)

    def keep(self, goal: Array | None = None) -> Sample:
        """A cycle in which each joint that can be held is, at its target or led towards `goal` (n,) [rad].

        Nothing is raised for a joint that the gate refuses (it brakes), that is silent or has a fault (it is told to
        stop), or whose drive stopped since it did not hear its host (it is switched on again where it stands). Raises
        BusFault where nothing could be sent for ENABLE_SECONDS.
        """
        loop, now = self.loop, self._await_turn()
        self._seen_now = seen = self._seen(now, True)
        others = self._others()
        self._commanded = [POSITION] * self.n
        for joint in range(self.n):
            order = self._kept(joint, seen[joint], others[joint], goal)
            self.passed[joint] = order or self._braked(joint, seen[joint])
        try:
            sample = self._keep_sending(now)
        except BusFault:
            self._mute_cycles += 1
            if self._mute_cycles > ENABLE_SECONDS / self.period:
                raise
            return loop.sample(now)
        self._mute_cycles = 0
        return sample

    def _keep_sending(self, now: float) -> Sample:
        try:
            return self.loop.exchange(self.passed, now)
        except Refused:  # what the bytes would say is beyond a limit: brake
            self.passed[:] = [self._braked(joint, each) for joint, each in enumerate(self._seen_now)]
            return self.loop.exchange(self.passed, now)

    def _kept(self, joint: int, seen: Seen, others: Corroboration, goal: Array | None) -> Order | None:
        """The order by which a joint is held; None where it cannot be."""
        limits, held, integral = self.limits[joint], self.passed[joint], self._integrals[joint]
        drives, drive = self._drives[joint]
        power = drives.power(drive)
        answers = is_fresh(seen.age, self.max_age) and math.isfinite(seen.position)
        if power is Power.FAULT or not answers or drives.has_restarted(drive):
            return None
        if self._is_doubtful(joint, seen, others):
            return None
        if power is Power.ON:
            self._caught.discard(joint)
            target = seen.position if held.mode != POSITION else held.position if goal is None else float(goal[joint])
            torque = 0.0
            if integral is not None:
                torque = integral.update(limits, POSITION, held.position, held.velocity, seen)
            order = pass_gate(limits, POSITION, torque, target, 0.0, held, seen, others)
            if order.refused:
                self._doubt(joint, order.refused, held)
            return order
        if power is not Power.STOPPED and joint not in self._caught and not drives.own_stop(drive):
            return None
        self._caught.add(joint)
        if integral is not None:
            integral.reset()
        order = hold_order(limits, 0.0, seen.position, seen)
        return order._replace(power=Power.ON, walk=True, mode=POSITION)

    def _doubt(self, joint: int, why: str, held: Order) -> None:
        """A refusal: where no motion explains the reading, the joint is believed to be where it was led before."""
        jumped = why == FOLLOWING and self.motion.unexplained[joint] > self.limits[joint].following / 2
        if why == CONTRADICTION or jumped:
            self._believed.setdefault(joint, held.position if held.mode == POSITION else math.nan)

    def _is_doubtful(self, joint: int, seen: Seen, others: Corroboration) -> bool:
        """Whether a joint would be held at a false place: until its reading is back where it was led, it is braked."""
        believed = self._believed.get(joint)
        if believed is None:
            return False
        if others.contradicted or not abs(seen.position - believed) <= BELIEVED_DISTANCE:
            return True
        del self._believed[joint]
        return False

    def _braked(self, joint: int, seen: Seen) -> Order:
        """The order to stop a joint as its drive can, from where it is believed to stand."""
        places = (self._believed.get(joint, math.nan), seen.position, self.passed[joint].position)
        position = next(each for each in places if math.isfinite(each))
        return start_order(self.limits[joint], seen.torque, position)._replace(power=Power.STOPPED)

    @property
    def held(self) -> list[bool]:
        """Which joints the newest cycle of `keep` held or led (n,)."""
        return [order.power is Power.ON and not order.walk for order in self.passed]

    def walk(self, target: Power) -> Sample:
        """Cycle until every joint is in `target` (ON or OFF), a step each cycle; returns the last sample.

        To be ON also takes that the joint is in position control and has told the torque that it now produces.
        Raises BusFault naming the joint that does not get there.
        """
        on = target is Power.ON
        self._believed.clear()
        self._commanded = [POSITION if on else OFF] * self.n
        since = [math.inf] * self.n
        for _ in range(max(int(ENABLE_SECONDS / self.period), STOP_CYCLES)):
            sample = self.stand([target] * self.n, walk=True)
            now = self.clock.now()
            reached = True
            for joint, power in enumerate(self.powers):
                if power is target:
                    since[joint] = min(since[joint], now)
                else:
                    since[joint], reached = math.inf, False
            reached = reached and bool(np.isfinite(sample.position).all())
            if reached and on:
                reached = self._torque_told(since) and all(drives.ready(drive) for drives, drive in self._drives)
            if reached:
                self.passed[:] = [order._replace(walk=False) for order in self.passed]
                return sample
            if self.loop.watch.intruder or self.restarted():
                break
        raise BusFault(self._stuck(target))

    def _stuck(self, target: Power) -> str:
        loop = self.loop
        why = bus_fault(self.names, loop.watch, 0)
        if why:
            return why
        for group in loop.groups:
            alarm = group.drives.alarm() if self.restarted() else None
            if alarm:
                return str(alarm)
        for drives, drive in self._drives:
            if drives.power(drive) is not target or (target is Power.ON and not drives.ready(drive)):
                return drives.stuck(drive, target, ENABLE_SECONDS)
        return f"in {ENABLE_SECONDS} s, no cycle had the readings of all joints: frames are lost"

    def restarted(self) -> bool:
        return any(drives.has_restarted(drive) for drives, drive in self._drives)

    @property
    def powers(self) -> list[Power]:
        """Newest power state of each joint's drive (n,)."""
        return [drives.power(drive) for drives, drive in self._drives]

    def _torque_told(self, since: list[float]) -> bool:
        """Whether each joint that has torque control has told its torque since it has power, from time `since` on."""
        columns = zip(self.loop.slow_seen, since, self._modes_of, strict=True)
        return all(seen >= on or Mode.TORQUE not in modes for seen, on, modes in columns)

    def stop(self) -> None:
        """Stop every joint, repeated until none is ON, as far as the bus still carries it."""
        power = [Power.STOPPED] * self.n
        for _ in range(STOP_CYCLES):
            with contextlib.suppress(BusFault):  # a queue that is full now may have room in the next cycle
                self.stand(power)
                if Power.ON not in self.powers:
                    break

    def _numbers(self, command: Command) -> tuple[list[int], list[float], list[float]]:
        """A command's fields as lists; raises Refused where they are not n numbers each, or a mode is not supported."""
        for field, kinds in (("mode", "iu"), ("torque", "iuf"), ("position", "iuf")):
            values = getattr(command, field)
            shape, kind = getattr(values, "shape", None), getattr(getattr(values, "dtype", None), "kind", "?")
            if shape != (self.n,) or kind not in kinds:
                raise Refused(
                    f"gate: field `{field}` of the command is an array of shape {shape} and kind {kind!r}: it "
                    f"must have shape ({self.n},) and hold {'whole ' if kinds == 'iu' else ''}numbers, one for "
                    f"each of {', '.join(self.names)}"
                )
        modes: list[int] = command.mode.tolist()
        for joint, mode in enumerate(modes):
            if mode and mode not in self._modes_of[joint] and mode in Mode.__members__.values():
                held = ", ".join(str(each) for each in sorted(self._modes_of[joint]) if each)
                raise Refused(
                    f"gate: {self.names[joint]}: mode {mode} is not supported: the drive of this joint has the modes "
                    f"{held}"
                )
        return modes, command.torque.tolist(), command.position.tolist()

    def _seen(self, now: float, healthy: bool) -> list[Seen]:
        loop, motion, oldest = self.loop, self.motion, now - self._slow_age
        torques = zip(loop.latest_motor_torque, loop.slow_seen, strict=True)
        velocities = zip(loop.latest_velocity, loop.speed_seen, strict=True)
        velocity = [value if came >= oldest else math.nan for value, came in velocities]
        motion.update(loop.latest_position, loop.earliest, loop.latest, velocity, loop.speed_seen)
        rows = zip(torques, velocity, loop.latest_position, loop.seen, strict=True)
        return [
            Seen(torque if told >= oldest else math.nan, position, turns, now - came, healthy)
            for (torque, told), turns, position, came in rows
        ]

    def _others(self) -> list[Corroboration]:
        motion = self.motion
        eased = [min(count * self.period / EASE_SECONDS, 1.0) for count in self._torque_cycles]
        bounds = (motion.proven, motion.ahead, motion.contradicted, self._ordered_torques(), eased)
        return [Corroboration(*each) for each in zip(*bounds, strict=True)]

    def _ordered_torques(self) -> list[float]:
        """Torque that the newest order of each drive with gains comes to [N·m], as its bytes tell it; else NaN."""
        if not self._with_gains:
            return [math.nan] * self.n
        loop = self.loop
        rows = zip(loop.told, loop.latest_position, loop.latest_velocity, strict=True)
        return [
            law_torque(told, position, velocity)
            if told is not None and told.kp > 0 and told.power is Power.ON
            else math.nan
            for told, position, velocity in rows
        ]

    def _verify(self, joint: int, sent: Order) -> None:
        """Raise Refused where the bytes that are about to leave order a joint something beyond a limit."""
        passed = self.passed[joint]
        if passed.power is not Power.ON:
            return
        limits = self.limits[joint]
        wrong = describe_excess(limits, passed, sent, self._seen_now[joint])
        if wrong:
            raise Refused(
                f"gate: {self.names[joint]}: the frame would command {wrong}, but the limits are "
                f"{limits.most_sent:.6g} N·m and {limits.lower:.4g} to {limits.upper:.4g} rad: the frame is not sent"
            )

    def _fault(self, now: float, modes: Sequence[int]) -> BusFault | None:
        """The fault at time `now`; what the host's own lateness explains is put down to that and to nothing else, and
        what the state of the bus explains to that."""
        fault = self._drive_fault(now, modes)
        shown = bus_fault(self.names, self.loop.watch, self.loop.dropped)
        if self._gap_at + LATENESS_MEMORY >= now and self._gap > self.max_age:
            return HostLate(self._gap, self.max_age, self._own_stop())
        watch = self.loop.watch
        if shown is not None and (fault is None or watch.reception or watch.intruder or isinstance(fault, Silence)):
            return BusFault(shown)
        if fault is None:
            return None
        if self._gap_at + LATENESS_MEMORY >= now and self._gap > BLAME_SHARE * self.max_age:
            stopped = self._own_stop()
            if stopped or isinstance(fault, Silence):
                return HostLate(self._gap, self.max_age, stopped or str(fault))
        return fault

    def _drive_fault(self, now: float, modes: Sequence[int]) -> BusFault | None:
        groups = self.loop.groups
        for group in groups:
            fault = group.drives.alarm()
            if fault is not None:
                return fault
        silent = silence(self.names, self.loop.seen, now, self.max_age, self.loop.watch)
        if silent is not None:
            return silent
        for group in groups:
            own = modes if len(groups) == 1 else [modes[place] for place in group.places]
            fault = group.drives.fault(own, now)
            if fault is not None:
                return fault
        return None

    def _own_stop(self) -> str:
        """The first joint that stopped itself since it did not hear its host, in words; empty if none."""
        return next((stop for drives, drive in self._drives if (stop := drives.own_stop(drive))), "")

    def _note_gap(self, seconds: float, now: float) -> None:
        """No commands were sent for so long before `now` [s]; the longest of late is kept."""
        gap = seconds - self.period
        if gap > self.period and math.isfinite(gap) and (gap >= self._gap or now > self._gap_at + LATENESS_MEMORY):
            self._gap, self._gap_at = gap, now

    def settle(self) -> None:
        """Restart after an interruption: what came meanwhile, and how late the host was, is forgotten."""
        self.loop.settle()
        self.motion.restart()
        self._gap, self._gap_at = 0.0, -math.inf
        self._due = self.clock.now()

    def _await_turn(self) -> float:
        """Wait for the cycle's time and take in what came meanwhile; returns the time that it then is, by the clock."""
        if not self._lock_step and not self.loop.just_woke:
            self.clock.sleep_until(self._due)
        self.loop.drain()
        now = self.clock.now()
        if not self._lock_step:
            stats = self.loop.stats
            self.late = max(now - self._due, 0.0)
            stats.late += self.late > 0.1 * self.period
            stats.lateness.add(self.late)
            self._note_gap(now - self.loop.synced, now)
            self._due = max(self._due, now - self.period) + self.period
        return now
