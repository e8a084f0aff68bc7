"""Drives whose MIT command is packed alike (Damiao, CubeMars): commands within limits, damping,
orders of another host. Each family adds its set-up, its power states and its replies.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from armlink.arm_file import LinkJoint
from armlink.bus.port import Frame
from armlink.drives.base import BasicDrives, no_order
from armlink.drives.family import BROADCAST
from armlink.drives.mit_leash import damping, order_of, round_within
from armlink.drives.mit_packing import (
    Grid,
    MitCommand,
    Ranges,
    Special,
    command_in,
    grid_of,
    pack_command,
    pack_steps,
    special_of,
    unpack_command,
)
from armlink.drives.orders import Limits, Mode, Order, Power
from armlink.drives.traits import Traits
from armlink.errors import BusFault

POSITION = int(Mode.POSITION)


@dataclass
class MitKnown:
    """Newest state of one drive."""

    ranges: Ranges | None = None
    """By which frames are coded; None: not known yet."""
    grid: Grid | None = None
    """Of these ranges."""
    limits: Limits | None = None
    position: float = math.nan
    """Unwrapped [rad]."""
    velocity: float = math.nan
    damping: bool = False
    """The newest frame damps, whatever was ordered."""
    sent: Order | None = None

    def use(self, ranges: Ranges | None) -> None:
        """Code and decode by these ranges from now on."""
        self.ranges, self.grid = ranges, None if ranges is None else grid_of(ranges)


class MitDrives(BasicDrives):
    """The drives of one bus; their settings have `id` (of commands), `reply` (of replies) and `kd`."""

    def __init__(self, joints: Sequence[LinkJoint], traits: Traits, known: Sequence[MitKnown]) -> None:
        super().__init__(joints, traits)
        self._settings = [joint.settings for joint in joints]
        self._known = known
        self._joint_of = {settings.id: joint for joint, settings in enumerate(self._settings)}

    def routes(self) -> Mapping[int, int]:
        """Reply ids; drives that share one are told apart by the id in their replies."""
        replies = [settings.reply for settings in self._settings]
        return {reply: joint if replies.count(reply) == 1 else BROADCAST for joint, reply in enumerate(replies)}

    def commands(self) -> Mapping[int, str]:
        return {drive: f"MIT command to {self.names[joint]}" for drive, joint in self._joint_of.items()}

    def sent(self, joint: int) -> Order | None:
        return self._known[joint].sent

    def _command(self, joint: int, order: Order) -> Frame:
        """The command of an order, within the drive's limits after rounding."""
        known = self._known[joint]
        grid, limits = known.grid, known.limits
        if grid is None or limits is None:
            raise BusFault(f"{self.names[joint]}: a command before the set-up")
        _, _, mode, position, velocity, torque, kp, kd, _ = order
        asked = MitCommand(position, velocity, kp, kd, torque)
        if mode != POSITION:
            asked = MitCommand(position, velocity, 0.0, 0.0, torque)
        data = pack_steps(*round_within(asked, grid, limits, known.position, known.velocity))
        known.sent = order_of(command_in(data, grid))
        return self._settings[joint].id, data

    def _damp(self, joint: int) -> Frame:
        """No stiffness, no torque: the joint sinks slowly, and no torque leaves the limit on the way."""
        known = self._known[joint]
        assert known.ranges is not None
        assert known.limits is not None
        known.damping = True
        command = damping(self._settings[joint].kd, known.position, known.velocity, known.limits.max_torque)
        data = pack_command(command, known.ranges)
        known.sent = order_of(unpack_command(data, known.ranges))._replace(power=Power.STOPPED)
        return self._settings[joint].id, data

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        joint = self._joint_of.get(can_id)
        if joint is None or len(data) != 8:
            return None
        special = special_of(data)
        if special is not None:
            power = {Special.ENABLE: Power.ON, Special.DISABLE: Power.OFF}.get(special)
            return None if power is None else (joint, no_order()._replace(power=power))
        ranges = self._known[joint].ranges
        return None if ranges is None else (joint, order_of(unpack_command(data, ranges)))
