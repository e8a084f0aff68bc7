"""Moves the arm through the link: travel, creeping onto stops, pressing, resting until a reading is exact."""

from collections.abc import Iterator
from contextlib import closing, contextmanager

import numpy as np
import numpy.typing as npt

from armlink.drives.orders import Mode
from armlink.errors import Refused
from armlink.link.integral import slowest_time
from armlink.link.joints.groups import make_groups, traits_of
from armlink.link.reading_bounds import Crossed, ReadingBounds
from armlink.link.types import Command, Sample, Samples, Setpoints
from armlink.loop.open import ArmDriver
from calib.arm.kinematics import DriveLimits
from calib.arm.sweep_section import SweepSection
from calib.motion.encoder_check import EncoderCheck
from calib.motion.static_reading import SettleRule, StaticReading, average, stack
from calib.motion.trajectory import trajectory
from gcomp.arrays import Array, Mask

STALL = 0.2
"""Following error at which a joint counts as blocked [rad]."""
LOST = 0.05
"""Following error at which a joint is no longer asked to go where it was asked to [rad]."""
CREEP_AHEAD = 10
"""Rows that creeping is ahead of its samples: a job that is held up stops the creep after this many."""
CONTACT_LEAD = 0.015
"""A joint that its target leads by so much, and that does not move, stands at its stop [rad]."""
CONTACT_STILL = 0.15
"""Share of the approach speed below which a joint does not move."""
STOP_TOLERANCE = 0.06
"""How far from the arm file's place a stop may be found, beyond the position sensor's own error [rad]."""
SLIP = 0.01
"""How far a pressed joint may leave its stop [rad]."""
BOUNCE = 0.05
"""How far it may while all are being pressed: one that lands throws the others [rad]."""
BOUNCE_SECONDS, BOUNCE_LOOK, BOUNCE_STILL = 2.0, 0.15, 0.003
"""Longest time that joints may take to stand on their stops [s]; how long one looks [s]; way in that time of one that
stands [rad]."""
PRESS_SECONDS = 0.3
"""Time over which the torque of a joint at its stop rises to its bias."""
COAST, COAST_LOOK, COAST_STILL = 5.0, 0.1, 0.002
"""Longest time that joints may take to stop [s]; how often one looks [s]; way in that time of one that stands [rad]."""
CHECK_CYCLES = 5
"""Cycles from one look at the settle rule to the next."""


class Stalled(Refused):
    """A joint did not follow."""

    def __init__(self, name: str, position: float, target: float, joint: int) -> None:
        """Joint's name, where it stands and where it should go [rad], and its index."""
        self.name, self.position, self.joint = name, position, joint
        super().__init__(
            f"{name} stopped at {position:.3f} rad on the way to {target:.3f} rad: its drive is too weak "
            "there, its position loop yields to the load, or something is in the way"
        )


class Slipped(Refused):
    """A pressed joint left its stop."""

    def __init__(self, name: str, joint: int) -> None:
        super().__init__(f"{name} slipped off its stop")
        self.joint = joint


class Mover:
    """Holds the arm's command and changes it in small, safe ways. The link must be enabled."""

    def __init__(self, link: ArmDriver, section: SweepSection, limits: DriveLimits) -> None:
        """Take over an enabled link: every joint is held at its last target."""
        self.link, self.section, self.limits = link, section, limits
        self._traits = traits_of(make_groups(link.arm))
        self.average_to(section.standard_error)
        self.speed = section.travel_speed * limits.speed
        self.command = Command.hold(link.position_sent)
        link.catch_up()
        first = link.cycle(self.command)
        self.position: Array = first.position.copy()
        self.seen_at = first.t
        """Link time of the newest sample [s]."""
        own_clock = np.array([each.cadence == "cyclic" for each in self._traits])
        self._encoders = EncoderCheck(link.names, link.position_step, limits.speed, first.t, own_clock)
        self.pressed: Mask = np.zeros(link.n, dtype=bool)
        self.side = np.zeros(link.n)
        self.resolution = np.full(link.n, np.inf)
        self._nothing = np.full(link.n, np.nan)
        self._contact = self.position.copy()
        self._produced = np.zeros(link.n)
        self.contacts: dict[tuple[int, int], float] = {}
        """(joint, side) → reading at which that stop was found [rad]."""

    def resume(self) -> None:
        """After the link has recovered: take over where the arm stands, nothing pressed."""
        self.pressed[:] = False
        self.side[:] = 0.0
        self.command = Command.hold(self.link.position_sent)
        self.link.catch_up()
        self._encoders.forget()
        self.cycle()

    @property
    def known_resolution(self) -> Array:
        """Smallest step that each position sensor has shown (n,) [rad]; 0 where it has shown none."""
        return np.where(np.isfinite(self.resolution), self.resolution, 0.0)

    def average_to(self, share: float) -> None:
        """From now on average readings to this standard error, a share of rated torque."""
        drives = [joint.settings for joint in self.link.arm.require_link().joints]
        gains = [(getattr(each, "kp", 0.0), getattr(each, "kd", 0.0)) for each in drives]
        slowest = max(slowest_time(*each) for each in gains)
        every = max(each.torque_cycles for each in self._traits)
        self.rule = SettleRule.of(self.section, share * self.limits.rated, self.link.period, slowest, every)

    def cycle(self) -> Sample:
        """A cycle of the present command; raises Slipped when a pressed joint has left its stop, EncoderFault."""
        with self._named():
            return self._see(self.link.cycle(self.command))

    def _play(self, setpoints: Setpoints) -> Samples:
        """The samples of commands that are sent ahead; raises Slipped, Stalled, EncoderFault."""
        row = 0
        with self._named(), closing(self.link.play(setpoints)) as samples:
            try:
                for row, sample in enumerate(samples):
                    yield self._see(sample)
                    row += 1
            finally:
                now = setpoints.command(min(row, len(setpoints) - 1))
                self.command.position, self.command.torque = now.position.copy(), now.torque.copy()

    def _see(self, sample: Sample) -> Sample:
        self.seen_at = sample.t
        self._encoders.see(sample, self.position)
        np.copyto(self.position, sample.position, where=np.isfinite(sample.position))
        return sample

    @contextmanager
    def _named(self) -> Iterator[None]:
        """A crossed bound as what it means here."""
        try:
            yield
        except Crossed as crossed:
            if crossed.sample is not None:
                self._see(crossed.sample)
            if crossed.bound == "range":
                raise Slipped(crossed.name, crossed.joint) from None
            raise Stalled(crossed.name, crossed.position, crossed.target, crossed.joint) from None

    def _guard_stops(self, slack: float) -> None:
        """From now on a pressed joint that leaves its stop by more than `slack` [rad] raises Slipped."""
        lower = np.where(self.pressed & (self.side > 0), self._contact - slack, -np.inf)
        upper = np.where(self.pressed & (self.side < 0), self._contact + slack, np.inf)
        self.command.guard = ReadingBounds(lower, upper, np.full(self.link.n, np.inf)) if self.pressed.any() else None

    def hold_all(self) -> None:
        self.pressed[:] = False
        self.side[:] = 0.0
        self.command.guard = None
        lost = np.abs(self.command.position - self.position) > LOST
        joints = (self.command.mode != Mode.POSITION) | lost
        self.command.mode[:] = Mode.POSITION
        self.command.position[joints] = self.position[joints]

    def come_to_rest(self) -> None:
        """Hold every joint where it stands until all have stopped: one with a weak drive coasts on at first."""
        cycles = max(int(COAST_LOOK / self.link.period), 2)
        for _ in range(round(COAST / COAST_LOOK)):
            self.hold_all()
            before = self.position.copy()
            for _ in range(cycles):
                self.cycle()
            if np.abs(self.position - before).max() < COAST_STILL:
                return

    def travel(self, goal: Array, acceleration: float) -> None:
        """Move the joints under position control to goal (n,) [rad], together; raises Stalled, EncoderFault."""
        movable = self.command.mode == Mode.POSITION
        goal = np.where(movable, goal, self.command.position)
        path = trajectory(
            self.command.position.copy(), goal, self.speed, np.full(len(goal), acceleration), self.link.period
        )
        if not len(path):  # they stand there
            return
        held = self.command.guard or ReadingBounds.none(self.link.n)
        guard = ReadingBounds(held.lower, held.upper, np.where(movable, STALL, np.inf))
        targets = np.where(movable, path, self.command.position)
        try:
            samples = list(self._play(Setpoints(self.command.mode, self.command.torque, targets, guard)))
        except Stalled as stalled:
            raise Stalled(stalled.name, stalled.position, float(goal[stalled.joint]), stalled.joint) from None
        seen = [sample.position if sample.all_timely else self._nothing for sample in samples]
        self._learn_resolution(seen)
        self._encoders.judge(np.reshape(seen, path.shape), path, movable, self.resolution)

    def follow(self, rows: Array, guard: ReadingBounds) -> list[Sample]:
        """The samples along targets (K, n) [rad], every joint under position control; raises Stalled, EncoderFault."""
        return list(self._play(Setpoints(self.command.mode, self.command.torque, rows, guard)))

    def press(self, stops: npt.NDArray[np.int64], bias: Array) -> None:
        """Creep the joints with stops ±1 onto them, then press with bias (n,) [N·m]; raises Refused, Slipped."""
        joints = stops != 0
        self._contact = self._creep(stops, joints, bias * stops)
        self.side = np.where(joints, stops, 0).astype(float)
        self.pressed = joints.copy()
        self._guard_stops(BOUNCE)
        self.command.mode[joints] = Mode.TORQUE
        cycles = max(int(PRESS_SECONDS / self.link.period), 1)
        start = np.where(joints, self._produced, 0.0)
        shares = np.linspace(1 / cycles, 1.0, cycles)[:, None]
        ramp = np.where(joints, start + shares * (bias - start), self.command.torque)
        position = np.tile(self.command.position, (cycles, 1))
        for _ in self._play(Setpoints(self.command.mode, ramp, position, self.command.guard)):
            pass
        self._stand(joints)
        self._guard_stops(SLIP)
        self.cycle()
        for joint in np.flatnonzero(joints):
            self._check_stop(int(joint), int(stops[joint]))
        self._contact = self.position.copy()
        self._guard_stops(SLIP)

    def touch(self, stops: npt.NDArray[np.int64]) -> Array:
        """Creep the joints with stops ±1 onto them and leave them there under position control; positions (n,) [rad].

        Raises Refused where a stop is not at the arm file's place.
        """
        self._creep(stops, stops != 0, self.limits.max_torque)
        for joint in np.flatnonzero(stops):
            self._check_stop(int(joint), int(stops[joint]))
        return self.position.copy()

    def before_stop(self, joint: int, side: int, gap: float) -> float:
        """Position [rad] a gap before a stop: where it was found last, else where the arm file has it."""
        found = self.contacts.get((joint, side))
        if found is not None:
            return found - side * gap / 2
        limit = float(self.limits.upper[joint] if side > 0 else self.limits.lower[joint])
        return limit - side * (gap + 0.02 * abs(limit))

    def rest(self, counts: Mask) -> StaticReading:
        """Wait until all has settled and the torque averages that `counts` (n,) are exact enough; raises Slipped.

        The time to settle ends where an average begins: at a low rate that takes as long again.
        """
        rule, samples, resolution = self.rule, list[Sample](), self.known_resolution
        window, timeout = rule.window * self.link.period, rule.timeout * self.link.period
        begin: int | None = None
        self.link.catch_up()

        def settled(some: list[Sample]) -> bool:
            return rule.settled(stack(some, "position"), stack(some, "torque"), counts, resolution)

        while True:
            samples.append(self.cycle())
            count = len(samples)
            if not self._lasted(samples, window) or (count - rule.window) % CHECK_CYCLES:
                continue
            if begin is None:
                if self._lasted(samples, timeout):
                    return average(samples[-rule.max_samples :], settled=False)
                if settled(samples[self._since(samples, window) :]):
                    # what settled last still decays in the first half
                    begin = self._since(samples, rule.window // 2 * self.link.period)
                continue
            of_average = samples[begin:]
            if not self._lasted(of_average, window):
                continue
            if len(of_average) < rule.max_samples and not rule.exact(stack(of_average, "torque"), counts):
                continue
            if settled(of_average):
                return average(of_average, settled=True)
            middle = (begin + count) // 2
            decayed = settled(samples[middle:])  # else it only stood at a turning point
            if decayed and self._lasted(samples, timeout + rule.max_samples * self.link.period):
                return average(samples[middle:], settled=True)
            begin = middle if decayed else None

    def _lasted(self, samples: list[Sample], seconds: float) -> bool:
        """Whether the samples cover so much time, a period each at least."""
        return bool(samples) and samples[-1].t - samples[0].t > seconds - 1.5 * self.link.period

    def _since(self, samples: list[Sample], seconds: float) -> int:
        """Index of the first sample of the last `seconds`."""
        begin = samples[-1].t - seconds + 0.5 * self.link.period
        return next(index for index, sample in enumerate(samples) if sample.t > begin)

    def _stand(self, joints: Mask) -> None:
        """Wait until pressed joints stand, `BOUNCE_SECONDS` at most; raises Slipped where one leaves its stop."""
        still = np.maximum(BOUNCE_STILL, 1.5 * self.known_resolution)
        look = max(int(BOUNCE_LOOK / self.link.period), 2)
        for _ in range(round(BOUNCE_SECONDS / BOUNCE_LOOK)):
            low, high = self.position.copy(), self.position.copy()
            for _ in range(look):
                self.cycle()
                low, high = np.minimum(low, self.position), np.maximum(high, self.position)
            if np.all((high - low < still) | ~joints):
                return

    def _creep(self, stops: npt.NDArray[np.int64], joints: Mask, bias: Array) -> Array:
        """Move each joint towards its stop until it does not follow any more.

        Returns where joints (n,) [rad] stood when their drives last pushed with less than `bias` (n,) [N·m]: a stiff
        position loop pushes with more before it stops following, and the stop yields.
        """
        contact = self.position.copy()
        stride = np.minimum(self.section.approach_speed, self.limits.speed) * self.link.period * stops
        window = max(int(0.1 / self.link.period), 4)
        read, asked, open_joints = [self.position.copy()], [self.command.position.copy()], joints.copy()
        while open_joints.any():
            ahead = np.tile(np.where(open_joints, stride, 0.0), (CREEP_AHEAD, 1))
            rows = np.cumsum(np.vstack([self.command.position, ahead]), axis=0)[1:]
            command = self.command
            with closing(self._play(Setpoints(command.mode, command.torque, rows, command.guard))) as samples:
                for row, sample in zip(rows, samples, strict=True):
                    np.copyto(self._produced, sample.motor_torque, where=np.isfinite(sample.motor_torque))
                    read.append(self.position.copy())
                    asked.append(row)
                    np.copyto(contact, self.position, where=open_joints & (self._produced * stops < bias))
                    if len(read) <= window:
                        continue
                    moved, wanted = (self.position - read[-window]) * stops, np.abs(row - asked[-window - 1])
                    still = moved < CONTACT_STILL * wanted
                    touched = open_joints & still & ((row - self.position) * stops > CONTACT_LEAD)
                    for joint in np.flatnonzero(open_joints & ~touched):
                        self._check_creep(int(joint), int(stops[joint]), float(row[joint]))
                    if touched.any():
                        open_joints = open_joints & ~touched
                        break
        return contact

    def _check_creep(self, joint: int, side: int, target: float) -> None:
        """Raise Refused if a joint's target [rad] has gone beyond the place at which its stop should have been."""
        limit = float(self.limits.upper[joint] if side > 0 else self.limits.lower[joint])
        beyond = side * (target - limit)
        if beyond > 2 * STOP_TOLERANCE + 0.03 * abs(limit):
            raise Refused(
                f"{self.link.names[joint]}: no stop was found at {limit:.3f} rad (the joint went to "
                f"{self.position[joint]:.3f} rad): correct the range in the arm file, or, if this joint has no stop, "
                "sweep with `--hold servo`"
            )

    def _check_stop(self, joint: int, side: int) -> None:
        """Note where a stop was found; raise Refused where that is not the stop of the arm file."""
        limit = float(self.limits.upper[joint] if side > 0 else self.limits.lower[joint])
        found = float(self.position[joint])
        if abs(found - limit) > STOP_TOLERANCE + 0.025 * abs(limit):
            raise Refused(
                f"{self.link.names[joint]} was blocked at {found:.3f} rad, but its stop should be at "
                f"{limit:.3f} rad: is something in the way, or is the range in the arm file wrong? If this "
                "joint has no stop, sweep with `--hold servo`"
            )
        self.contacts[joint, side] = found

    def _learn_resolution(self, seen: list[Array]) -> None:
        """Keep the smallest step that each position sensor has shown."""
        if len(seen) < 2:
            return
        steps = np.abs(np.diff(np.array(seen), axis=0))
        steps = np.where(steps > 1e-9, steps, np.inf)
        self.resolution = np.minimum(self.resolution, np.nanmin(np.where(np.isnan(steps), np.inf, steps), axis=0))
