"""Drives with the MIT law kp (q* − q) + kd (dq* − dq) + τ: commands within limits, damping, set-up, another host.

Nothing in such a drive bounds that sum but its own saturation. A family adds what its frames look like, where its
scales come from, its power states and its replies.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from armlink.arm_file import LinkJoint
from armlink.bus.port import Frame
from armlink.drives.base import BROADCAST, BasicDrives, DriveMemory, no_order
from armlink.drives.mit_packing import Grid, MitCommand, Special, pack_steps, special_of, unpack_command
from armlink.drives.orders import Gains, Limits, Mode, Order, Power, ReadingRange, Setup, law_torque
from armlink.drives.traits import Traits
from armlink.errors import BadInput, BusFault

DAMPING_SHARE = 0.9
"""Damping takes at most this share of the torque limit; the rest is for rounding."""
GAIN_FACTOR, GAIN_STEPS = 0.8, 30
"""Factor by which both gains are lowered, again and again, while the sum of the law is beyond the limit."""
Steps = tuple[int, int, int, int, int]
ON, POSITION, TORQUE = Power.ON, int(Mode.POSITION), int(Mode.TORQUE)


@dataclass
class MitMemory(DriveMemory):
    """Positions are unwrapped."""

    grid: Grid | None = None
    """By which frames are coded; None: not known yet."""
    damping: bool = False
    """The newest frame damps, whatever was ordered."""


K = TypeVar("K", bound=MitMemory)


class MitDrives(BasicDrives[K]):
    """The drives of one bus; their settings have `id` (of commands), `reply` (of replies), `kp` and `kd`.

    Frames are those of `mit_packing`; a family with others overrides what codes and decodes them.
    """

    def __init__(self, joints: Sequence[LinkJoint], traits: Traits, memory: type[K]) -> None:
        super().__init__(joints, traits, memory)
        self._joint_of = {settings.id: joint for joint, settings in enumerate(self.settings)}

    def routes(self) -> Mapping[int, int]:
        """Reply ids; drives that share one are told apart by the id in their replies."""
        replies = [settings.reply for settings in self.settings]
        return {reply: joint if replies.count(reply) == 1 else BROADCAST for joint, reply in enumerate(replies)}

    def commands(self) -> Mapping[int, str]:
        return {drive: f"MIT command to {self.names[joint]}" for drive, joint in self._joint_of.items()}

    def coded(self, joint: int, steps: Steps) -> Frame:
        return self.settings[joint].id, pack_steps(*steps)

    def decoded(self, can_id: int, data: bytes, grid: Grid) -> MitCommand:
        """A command frame as the drive understands it; `data` has eight bytes."""
        return unpack_command(data, grid)

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        joint = self._joint_of.get(can_id)
        if joint is None or len(data) != 8:
            return None
        special = special_of(data)
        if special is not None:
            power = {Special.ENABLE: Power.ON, Special.DISABLE: Power.OFF}.get(special)
            return None if power is None else (joint, no_order()._replace(power=power))
        grid = self.memory[joint].grid
        return None if grid is None else (joint, order_of(self.decoded(can_id, data, grid)))

    def grid_of(self, joint: int) -> Grid:
        grid = self.memory[joint].grid
        if grid is None:
            raise BusFault(f"{self.names[joint]}: a command came before the set-up")
        return grid

    def joint_frames(self, joint: int, order: Order, now: float) -> Sequence[Frame]:
        known = self.memory[joint]
        known.damping = False
        if self.follows(joint, now) and order.power is not Power.OFF:
            return (self.command(joint, order) if order.power is ON else self.damp(joint),)
        known.sent = None
        return self.switching(joint, order, now)

    def follows(self, joint: int, now: float) -> bool:
        """Whether a drive has power and follows commands, by what is known of it."""
        raise NotImplementedError

    def switching(self, joint: int, order: Order, now: float) -> Sequence[Frame]:
        """Frames for a drive that does not follow commands, or is to be off: the next step, or a question."""
        raise NotImplementedError

    def command(self, joint: int, order: Order) -> Frame:
        known, limits, grid = self.memory[joint], self.limits_of(joint), self.grid_of(joint)
        _, _, mode, position, velocity, torque, kp, kd, _ = order
        asked = MitCommand(position, velocity, *((kp, kd) if mode == POSITION else (0.0, 0.0)), torque)
        return self._sent(joint, grid, round_within(asked, grid, limits, known.position, known.velocity), ON)

    def damp(self, joint: int) -> Frame:
        """No stiffness, no torque: the joint sinks slowly, and no torque leaves the limit on the way."""
        known, grid = self.memory[joint], self.grid_of(joint)
        known.damping = True
        most = self.limits_of(joint).max_torque
        command = damping(self.settings[joint].kd, known.position, known.velocity, most)
        return self._sent(joint, grid, grid.steps(command), Power.STOPPED)

    def safe_frames(self, joint: int) -> Sequence[Frame]:
        """It holds where it stands, with the torque that the newest order came to there; it damps where it damped.

        The stiffer, the more a joint is pulled that moves on until the frame comes: within its torque limit.
        """
        known, settings = self.memory[joint], self.settings[joint]
        if known.sent is None:
            return ()
        limits, grid, position, velocity = self.limits_of(joint), self.grid_of(joint), known.position, known.velocity
        if known.damping or not math.isfinite(position):
            steps = grid.steps(damping(settings.kd, position, velocity, limits.max_torque))
        else:
            speed = velocity if math.isfinite(velocity) else 0.0
            torque = law_torque(known.sent, position, speed)
            target, drift = max(limits.lower, min(limits.upper, position)), abs(speed) * limits.deadline
            room = max(limits.max_torque - abs(torque), 0.0)
            kp = room / drift if settings.kp * drift > room else settings.kp
            held = MitCommand(target, 0.0, kp, settings.kd, torque)
            steps = round_within(held, grid, limits, position, velocity)
        return (self.coded(joint, steps),)

    def _sent(self, joint: int, grid: Grid, steps: Steps, power: Power) -> Frame:
        frame = self.coded(joint, steps)
        self.memory[joint].sent = order_of(self.decoded(*frame, grid), power)
        return frame

    def mit_setup(
        self,
        joint: int,
        limits: Limits,
        position: float,
        grid: Grid,
        notes: Sequence[str],
        where: tuple[str, str, str],
        remedy: str,
    ) -> Setup:
        """Set-up of a drive without power at `position` [rad], from which its cycles start.

        `where` the ranges of position, velocity and torque come from, and how they are made larger.
        """
        known, settings, ranges = self.memory[joint], self.settings[joint], grid.ranges
        known.grid, known.limits, known.position = grid, limits, position
        quantities = zip(("position", "velocity", "torque"), ranges[:3], where, strict=True)
        return Setup(
            position=position,
            torque=0.0,
            position_step=grid.position.span / grid.position.most,
            modes=frozenset((POSITION, TORQUE)),
            gains=Gains(settings.kp, settings.kd, ranges.kp, ranges.kd),
            notes=tuple(notes),
            scales={
                "position range, rad": ranges.position,
                "velocity range, rad/s": ranges.velocity,
                "torque range, N·m": ranges.torque,
            },
            ranges=tuple(ReadingRange(*each, remedy) for each in quantities),
        )

    def require_window(self, joint: int, limits: Limits, grid: Grid, where: str = "") -> None:
        """Raise BadInput unless a joint's position window lies in the range of its drive's frames, which is `where`."""
        most = grid.ranges.position
        if not (-most <= limits.lower and limits.upper <= most):
            raise BadInput(
                f"{self.names[joint]}: its position window at the drive, {limits.lower:.2f} to "
                f"{limits.upper:.2f} rad, exceeds the range of the drive's frames, ±{most:.2f} rad{where}: "
                "correct zero and direction, or give the joint a smaller range"
            )


def order_of(command: MitCommand, power: Power = ON) -> Order:
    """The order that a command stands for: position control where it has stiffness."""
    position, velocity, kp, kd, torque = command
    return Order(power, False, POSITION if kp > 0 else TORQUE, position, velocity, torque, kp, kd)


def round_within(command: MitCommand, grid: Grid, limits: Limits, position: float, velocity: float) -> Steps:
    """Steps of a command, moved by as few as it takes to stay within `limits` after rounding.

    `position` and `velocity` are the newest readings (NaN if there are none), by which the sum of the law is bounded;
    the torque alone and the target position are bounded in any case.

    Raises ValueError for numbers that are not finite.
    """
    most = limits.max_torque
    wanted = command.position
    if most < abs(command.torque) < math.inf:
        command = command._replace(torque=math.copysign(most, command.torque))
    q, dq, kp, kd, t = grid.steps(command)
    if kp and limits.lower <= wanted <= limits.upper:
        at = grid.position.value(q)
        q += (at < limits.lower) - (at > limits.upper)
    t = _torque_within(t, grid, most)
    if not math.isfinite(position + velocity):
        return q, dq, kp, kd, t
    pull = _pull(q, dq, kp, kd, grid, position, velocity)
    total = pull + grid.torque.value(t)
    if abs(total) <= most:
        return q, dq, kp, kd, t
    beyond = total - math.copysign(most, total)
    quantum = grid.torque.span / grid.torque.most
    t = _torque_within(t - math.ceil(abs(beyond) / quantum) * (1 if beyond > 0 else -1), grid, most)
    torque = grid.torque.value(t)
    for _ in range(GAIN_STEPS):  # where the torque, limited by itself, cannot keep the sum within the limit
        if abs(pull + torque) <= most:
            return q, dq, kp, kd, t
        kp, kd = int(GAIN_FACTOR * kp), int(GAIN_FACTOR * kd)
        pull = _pull(q, dq, kp, kd, grid, position, velocity)
    return q, dq, 0, 0, t


def damping(kd: float, position: float, velocity: float, most: float) -> MitCommand:
    """A command that damps with at most `kd`, and with no more torque than `most` [N·m] at the present velocity."""
    if abs(velocity) * kd > DAMPING_SHARE * most:
        kd = DAMPING_SHARE * most / abs(velocity)
    return MitCommand(position if math.isfinite(position) else 0.0, 0.0, 0.0, kd, 0.0)


def _pull(q: int, dq: int, kp: int, kd: int, grid: Grid, position: float, velocity: float) -> float:
    """Torque of both gains where the drive stands [N·m]."""
    stiff = grid.kp.value(kp) * (grid.position.value(q) - position)
    return stiff + grid.kd.value(kd) * (grid.velocity.value(dq) - velocity)


def _torque_within(steps: int, grid: Grid, most: float) -> int:
    """Steps of a torque, moved inwards until it is within ±most [N·m] and the range."""
    field = grid.torque
    steps = max(0, min(int(field.most), steps))
    torque = field.value(steps)
    if abs(torque) <= most:
        return steps
    steps = field.steps(math.copysign(most, torque))
    beyond = abs(field.value(steps)) > most  # the limit lies between two steps
    return steps - (1 if torque > 0 else -1) * beyond
