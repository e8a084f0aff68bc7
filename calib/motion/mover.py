"""Moves the arm through the link: travel, creeping onto stops, pressing, resting until a reading is exact."""

import numpy as np
import numpy.typing as npt

from armlink.errors import Refused
from armlink.link.link import Link
from armlink.link.types import Command, Sample
from calib.arm.drive_limits import Limits
from calib.arm.sweep_section import SweepSection
from calib.motion.encoder_check import EncoderCheck
from calib.motion.settle_rule import SettleRule
from calib.motion.static_reading import StaticReading, average, stack
from calib.motion.trajectory import trajectory

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

POSITION, TORQUE = 8, 10
STALL = 0.2
"""Following error at which a joint counts as blocked [rad]."""
LOST = 0.05
"""Following error at which a joint is no longer asked to go where it was asked to [rad]."""
SLIP = 0.01
"""How far a pressed joint may leave its stop [rad]."""
CONTACT_LEAD = 0.015
"""A joint that its target leads by so much, and that does not move, stands at its stop [rad]."""
CONTACT_STILL = 0.15
"""Share of the approach speed below which a joint does not move."""
CHECK_EVERY = 5
"""Cycles from one look at the settle rule to the next."""
COAST, COAST_LOOK, COAST_STILL = 5.0, 0.1, 0.002
"""Longest time that joints may take to stop [s]; how often one looks [s]; way in that time of one that stands [rad]."""
BOUNCE = 0.05
"""How far it may while all are being pressed: one that lands throws the others [rad]."""
PRESS_SECONDS = 0.3
"""Time over which the torque of a joint at its stop rises to its bias."""
BOUNCE_SECONDS, BOUNCE_LOOK, BOUNCE_STILL = 2.0, 0.15, 0.003
"""Longest time that joints may take to stand on their stops [s]; how long one looks [s]; way in that time of one that
stands [rad]."""
STOP_TOLERANCE = 0.06
"""How far from the arm file's place a stop may be found, beyond the position sensor's own error [rad]."""


class Stalled(Refused):
    """A joint did not follow."""

    def __init__(self, name: str, position: float, target: float) -> None:
        """Joint's name, where it stands and where it should go [rad]."""
        super().__init__(
            f"{name}: stopped at {position:.3f} rad on the way to {target:.3f}: its drive is too weak there,"
            " its position loop does not bear the load, or something is in the way"
        )


class Slipped(Refused):
    """A pressed joint left its stop."""

    def __init__(self, name: str, joint: int) -> None:
        """Joint's name and index."""
        super().__init__(f"{name}: slipped off its stop")
        self.joint = joint


class Mover:
    """Holds the arm's command and changes it in small, safe ways. The link must be enabled."""

    def __init__(self, link: Link, section: SweepSection, limits: Limits) -> None:
        """Take over an enabled link: every joint is held at its last target."""
        self.link, self.section, self.limits = link, section, limits
        self.average_to(section.standard_error)
        self.speed = section.travel_speed * limits.speed
        self.command = Command.hold(link.position_sent)
        first = link.cycle(self.command)
        self.position: Array = first.position.copy()
        self._encoders = EncoderCheck(link.names, link.position_step, limits.speed, first.t)
        self.pressed: Flags = np.zeros(link.n, dtype=bool)
        self.side = np.zeros(link.n)
        self.resolution = np.full(link.n, np.inf)
        self._slack = SLIP
        self._contact = self.position.copy()
        self._produced = np.zeros(link.n)
        self.contacts: dict[tuple[int, int], float] = {}
        """(joint, side) → reading at which that stop was found [rad]."""

    @property
    def known_resolution(self) -> Array:
        """Smallest step that each position sensor has shown (n,) [rad]; 0 where it has shown none."""
        return np.where(np.isfinite(self.resolution), self.resolution, 0.0)

    def average_to(self, share: float) -> None:
        """From now on average readings to this standard error, a share of rated torque."""
        self.rule = SettleRule.of(self.section, share * self.limits.rated, self.link.period)

    def cycle(self) -> Sample:
        """One cycle of the present command; raises Slipped when a pressed joint has left its stop, EncoderFault."""
        sample = self.link.cycle(self.command)
        self._encoders.see(sample, self.position)
        np.copyto(self.position, sample.position, where=np.isfinite(sample.position))
        if self.pressed.any():
            off = self.side * (self._contact - self.position) > self._slack
            if off.any():
                joint = int(np.argmax(off & self.pressed))
                raise Slipped(self.link.names[joint], joint)
        return sample

    def hold_all(self) -> None:
        """Every joint under position control where it stands."""
        self.pressed[:] = False
        self.side[:] = 0.0
        lost = np.abs(self.command.position - self.position) > LOST
        joints = (self.command.mode != POSITION) | lost
        self.command.mode[:] = POSITION
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
        movable = self.command.mode == POSITION
        goal = np.where(movable, goal, self.command.position)
        path = trajectory(
            self.command.position.copy(), goal, self.speed, np.full(len(goal), acceleration), self.link.period
        )
        seen = []
        for target in path:
            self.command.position[movable] = target[movable]
            seen.append(self.cycle().position)
            lag = np.abs(self.command.position - self.position)
            if lag[movable].max() > STALL:
                joint = int(np.argmax(np.where(movable, lag, 0.0)))
                raise Stalled(self.link.names[joint], float(self.position[joint]), float(goal[joint]))
        self._learn_resolution(seen)
        self._encoders.judge(np.reshape(seen, path.shape), path, movable, self.resolution)

    def press(self, stops: npt.NDArray[np.int64], bias: Array) -> None:
        """Creep the joints with stops ±1 onto them, then press with bias (n,) [N·m]; raises Refused, Slipped."""
        joints = stops != 0
        self._creep(stops, joints)
        self._contact = self.position.copy()
        self.side = np.where(joints, stops, 0).astype(float)
        self.pressed, self._slack = joints.copy(), BOUNCE
        self.command.mode[joints] = TORQUE
        cycles = max(int(PRESS_SECONDS / self.link.period), 1)
        start = np.where(joints, self._produced, 0.0)
        for share in np.linspace(1 / cycles, 1.0, cycles):
            self.command.torque[joints] = (start + share * (bias - start))[joints]
            self.cycle()
        self._stand(joints)
        self._slack = SLIP
        self.cycle()
        for joint in np.flatnonzero(joints):
            self._check_stop(int(joint), int(stops[joint]))
        self._contact = self.position.copy()

    def touch(self, stops: npt.NDArray[np.int64]) -> Array:
        """Creep the joints with stops ±1 onto them and leave them there under position control; positions (n,) [rad].

        Raises Refused where a stop is not at the arm file's place.
        """
        self._creep(stops, stops != 0)
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

    def rest(self, counts: Flags) -> StaticReading:
        """Wait until all has settled and the torque averages that `counts` (n,) are exact enough; raises Slipped."""
        rule, samples, resolution = self.rule, list[Sample](), self.known_resolution
        begin: int | None = None

        def settled(some: list[Sample]) -> bool:
            return rule.settled(stack(some, "position"), stack(some, "torque"), counts, resolution)

        while True:
            samples.append(self.cycle())
            count = len(samples)
            if count < rule.window or (count - rule.window) % CHECK_EVERY:
                continue
            if count >= rule.timeout:
                return average(samples[-rule.max_samples :], settled=False)
            if begin is None:
                if settled(samples[-rule.window :]):
                    begin = count - rule.window // 2  # what settled last still decays in the first half
            elif count - begin >= rule.window:
                enough = count - begin >= rule.max_samples
                if enough or rule.exact(stack(samples[begin:], "torque"), counts):
                    if settled(samples[begin:]):
                        return average(samples[begin:], settled=True)
                    begin = None  # it only stood at a turning point

    def _stand(self, joints: Flags) -> None:
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

    def _creep(self, stops: npt.NDArray[np.int64], joints: Flags) -> None:
        """Move each joint towards its stop until it does not follow any more."""
        period = self.link.period
        stride = np.minimum(self.section.approach_speed, self.limits.speed) * period * stops
        window = max(int(0.1 / period), 4)
        history, open_joints = [self.position.copy()], joints.copy()
        while open_joints.any():
            self.command.position[open_joints] += stride[open_joints]
            sample = self.cycle()
            np.copyto(self._produced, sample.motor_torque, where=np.isfinite(sample.motor_torque))
            history.append(self.position.copy())
            if len(history) <= window:
                continue
            moved = (self.position - history[-window]) * stops
            lead = (self.command.position - self.position) * stops
            still = moved < CONTACT_STILL * np.abs(stride) * window
            open_joints &= ~(still & (lead > CONTACT_LEAD))
            for joint in np.flatnonzero(open_joints):
                self._check_creep(int(joint), int(stops[joint]))

    def _check_creep(self, joint: int, side: int) -> None:
        """Raise Refused where a joint has gone beyond the place at which its stop should have been."""
        limit = float(self.limits.upper[joint] if side > 0 else self.limits.lower[joint])
        beyond = side * (self.command.position[joint] - limit)
        if beyond > 2 * STOP_TOLERANCE + 0.03 * abs(limit):
            raise Refused(
                f"{self.link.names[joint]}: no stop found at {limit:.3f} rad (went to {self.position[joint]:.3f}):"
                " check lower and upper in the arm file"
            )

    def _check_stop(self, joint: int, side: int) -> None:
        """Note where a stop was found; raise Refused where that is not the stop of the arm file."""
        limit = float(self.limits.upper[joint] if side > 0 else self.limits.lower[joint])
        found = float(self.position[joint])
        if abs(found - limit) > STOP_TOLERANCE + 0.025 * abs(limit):
            raise Refused(
                f"{self.link.names[joint]}: blocked at {found:.3f} rad, but its stop should be at {limit:.3f} rad:"
                " is something in the way, or the arm file's range wrong?"
            )
        self.contacts[joint, side] = found

    def _learn_resolution(self, seen: list[Array]) -> None:
        """Keep the smallest step that each position sensor has shown."""
        if len(seen) < 2:
            return
        steps = np.abs(np.diff(np.array(seen), axis=0))
        steps = np.where(steps > 1e-9, steps, np.inf)
        self.resolution = np.minimum(self.resolution, np.nanmin(np.where(np.isnan(steps), np.inf, steps), axis=0))
