"""MyActuator RMD-X drives on one bus (V3 protocol): a command and a request for the angle a cycle, and their replies.

The reply to a command tells the angle in whole degrees, so it is asked for in steps of 0.01° besides. No reply tells
whether the motor has power (`armlink.drives.untold_power`). One drive after the other is asked for its errors and for
the time since its start. A drive that got no command within its time-out has let go, and follows the next command at
once, so the host counts it as stopped by the time alone.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, TypeVar

from pydantic import Field, model_validator

from armlink.arm_file import ArmFile, LinkJoint, Positive
from armlink.bus.frame_bits import longest_frame_bits
from armlink.bus.port import Frame
from armlink.drives.base import BROADCAST, Ask, no_order
from armlink.drives.family import Discovery, Family
from armlink.drives.findings import FoundDrive
from armlink.drives.myactuator import frames
from armlink.drives.myactuator.frames import ANGLE, COMMAND_ID, CURRENT, LAST_ID, REPLY_ID, RmdCommand, request
from armlink.drives.orders import DriveIdentity, Limits, Mode, Order, Power, Reading, Setup
from armlink.drives.searched_bus import SearchedBus
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits
from armlink.drives.untold_power import UntoldMemory, UntoldPowerDrives, makes_torque
from armlink.errors import BadInput, BusFault

T = TypeVar("T")
TRAITS = Traits(
    torque="current", calibration="host", silence="keeps on", kept="holds", bounds=(), cadence="reply", frame="11"
)
"""Of a drive with the default keys; with a time-out it lets go."""
POLLED = (RmdCommand.ERROR, RmdCommand.RUNTIME)
LONGEST_PAUSE = 3_600_000
"""A time since the start that has passed by more, in 32 bits, has gone backwards: the drive has restarted. No host goes
on after it stood still for so long [ms]."""
LEAST_GEAR = 6.0
"""Of all models: a constant that is smaller by more than its root is nearer to the motor's than to the output's."""


class MyActuatorSettings(DriveSettings):
    """A MyActuator RMD-X drive (V3 protocol)."""

    family: Literal["myactuator"] = "myactuator"
    id: Annotated[int, Field(ge=1, le=LAST_ID)]
    model: str = ""
    """As on the label or as the drive tells it: its torque constant, where the key below does not give it."""
    torque_constant: Positive | None = None
    """Torque at the output for one ampere [N·m/A]; None: rated torque over rated current of the model."""
    timeout_ms: Annotated[int, Field(ge=0, le=2500)] = 0
    """Time-out of communication (B3h) as it was stored in the drive [ms]; 0: none, the drive keeps on."""

    @model_validator(mode="after")
    def _constant_is_known(self) -> "MyActuatorSettings":
        if self.torque_constant is None and self.model not in frames.RATINGS:
            raise ValueError(
                f"model {self.model!r} is unknown: give one of {', '.join(frames.RATINGS)}, or give torque_constant, "
                "the rated torque over the rated current of the data sheet"
            )
        usual = frames.torque_constant(self.model) if self.model in frames.RATINGS else 0.0
        if self.torque_constant is not None and self.torque_constant < usual / math.sqrt(LEAST_GEAR):
            raise ValueError(
                f"torque_constant {self.torque_constant:g} is that of the motor before the gear, so currents would be "
                f"too large: give the torque constant at the output ({usual:.3g} N·m/A for an {self.model})"
            )
        return self

    @property
    def constant(self) -> float:
        """[N·m/A]."""
        return self.torque_constant or frames.torque_constant(self.model)

    @property
    def address(self) -> str:
        return f"id {self.id}"


@dataclass
class MyActuatorMemory(UntoldMemory):
    awaited: int = 0
    """The command whose reply says what the drive does from now on."""
    stopping: bool = False
    """It was told to stand still, and has answered."""
    torque: float = math.nan
    """[N·m]."""
    error: int = 0
    runtime: int | None = None
    """Time since its start, as it last told it [ms]."""
    restarted: bool = False
    cycles: int = 0


class MyActuatorDrives(UntoldPowerDrives[MyActuatorMemory]):
    watch = "time-out"

    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint]) -> None:
        """Nothing is sent. Raises BadInput where a CANopen node on the bus would take replies for its own commands."""
        super().__init__(joints, TRAITS, MyActuatorMemory)
        self.let_go_where(settings.timeout_ms for settings in self.settings)
        self._joint_of = {settings.id: joint for joint, settings in enumerate(self.settings)}
        self._spare_canopen(arm)

    def _spare_canopen(self, arm: ArmFile) -> None:
        own = {row.bus for row in self.rows}
        for joint in arm.require_link().joints:
            node = getattr(joint.settings, "node", 0) if joint.settings.family == "canopen" else 0
            if joint.bus in own and node - 0x40 in self._joint_of:
                raise BadInput(
                    f"{arm.path}: {joint.name}: node {node} would read replies of the MyActuator drive {node - 0x40} "
                    "as commands (200h + node): give one of them another id"
                )

    # ---- identifiers

    def routes(self) -> Mapping[int, int]:
        return {REPLY_ID + drive: joint for drive, joint in self._joint_of.items()}

    def commands(self) -> Mapping[int, str]:
        found = {frames.ALL_ID: "command to all MyActuator drives", frames.SET_ID: "id to all MyActuator drives"}
        for drive, joint in self._joint_of.items():
            found |= {base + drive: f"command to {self.names[joint]}" for base in (COMMAND_ID, frames.MOTION_ID)}
        return found

    def cycle_bits(self) -> float:
        """Command, angle and their replies, and one drive's poll."""
        return (4 * self.m + 2) * longest_frame_bits(8)

    # ---- before the cycle

    def _ask(self, ask: Ask, joint: int, command: RmdCommand, decoded: Callable[[bytes], T]) -> T | None:
        """Ask for what this command's reply has, decoded; None where no reply comes."""
        drive = self.settings[joint].id

        def reply(can_id: int, data: bytes) -> T | None:
            mine = can_id == REPLY_ID + drive and len(data) == 8 and data[0] == command
            return decoded(data) if mine else None

        return ask((COMMAND_ID + drive, request(command)), reply)

    def identity(self, joint: int, ask: Ask) -> DriveIdentity:
        told = self._ask(ask, joint, RmdCommand.MODEL, frames.unpack_model)
        if told is None:
            return self.absent(joint)
        version = self._ask(ask, joint, RmdCommand.VERSION, frames.unpack_count)
        model, stated = frames.model_named(told), self.settings[joint].model
        wrong = f"the arm file states model {stated}" if model and stated and model != stated else ""
        return self.present(joint, f"MyActuator {told}".strip(), firmware=str(version or ""), mismatch=wrong)

    def position(self, joint: int, ask: Ask) -> float:
        told = self._ask(ask, joint, RmdCommand.ANGLE, frames.unpack_angle)
        return math.nan if told is None else told

    def prepare(self, ask: Ask, joint: int, limits: Limits) -> Setup:
        """Off, and read; nothing is written, for these drives keep what is written in their flash."""
        settings, name = self.settings[joint], self.names[joint]
        off = self._ask(ask, joint, RmdCommand.OFF, bytes)
        position = self._ask(ask, joint, RmdCommand.ANGLE, frames.unpack_angle)
        told = self._ask(ask, joint, RmdCommand.ERROR, frames.unpack_error)
        if off is None or position is None or told is None:
            raise BusFault(
                f"{name}: no answer from {settings.address}: check that the drive is powered, that its id and its bit "
                "rate are right, and that no active reply (B6h) is set in it"
            )
        self.memory[joint] = MyActuatorMemory(limits, None, position, 0.0, on=False, error=told[1])
        self.powers[joint] = Power.FAULT if told[1] else Power.OFF
        self.faults[joint] = frames.error_text(told[1])
        notes = [_watched(settings), "the torque constant is taken from the arm file, since the drive reports none"]
        planned = self._ask(ask, joint, RmdCommand.ACCELERATION, frames.unpack_count)
        if planned:
            notes.append(
                f"it plans its own path to each position target, with {planned} °/s²: set acceleration and "
                "deceleration of its position loop to 0, so that it follows every target directly"
            )
        return Setup(
            position=position,
            torque=0.0,
            position_step=ANGLE,
            modes=frozenset((int(Mode.POSITION), int(Mode.TORQUE))),
            notes=tuple(notes),
            scales={"torque constant, N·m/A": settings.constant},
        )

    # ---- the cycle

    def _frame(self, joint: int, data: bytes) -> Frame:
        return COMMAND_ID + self.settings[joint].id, data

    def joint_frames(self, joint: int, order: Order, now: float) -> Sequence[Frame]:
        known = self.memory[joint]
        self.limits_of(joint)
        self.expire(joint, now, self.settings[joint].timeout_ms / 1000 or math.inf)
        known.sent, data = None, request(RmdCommand.STATUS)
        if order.power is Power.ON and known.on:
            known.stopping, data = False, self._command(joint, order)
        elif order.power is Power.ON and order.walk and not (known.on or known.error or known.restarted):
            # by position whatever the mode is, for a torque does not open a brake: the ordered one, which is bounded
            position = order.position if order.mode == Mode.POSITION else known.position
            data = self._command(joint, order._replace(mode=Mode.POSITION, position=position))
            known.awaited, known.stopped = data[0], False
        elif order.power is Power.STOPPED and known.on:
            if not known.stopping:
                data = request(RmdCommand.STOP)
                known.awaited = data[0]
        elif known.on is not False:
            known.on, known.stopping, data = None, False, request(RmdCommand.OFF)
            known.awaited = data[0]
        known.commanded = now
        turn, place = divmod(known.cycles, self.m)
        known.cycles += 1
        polls = [request(POLLED[turn % len(POLLED)])] if place == joint else []
        return [self._frame(joint, each) for each in (data, request(RmdCommand.ANGLE), *polls)]

    def _command(self, joint: int, order: Order) -> bytes:
        """Raises ValueError for numbers that are not finite."""
        limits = self.limits_of(joint)
        if order.mode == Mode.TORQUE:
            quantum = CURRENT * self.settings[joint].constant
            most = min(math.floor(limits.max_torque / quantum), frames.MOST_CURRENT)
            data = frames.pack_torque(max(-most, min(most, _steps(order.torque, quantum))))
        else:
            _steps(order.velocity, ANGLE)
            steps = max(-frames.MOST_ANGLE, min(frames.MOST_ANGLE, _steps(order.position, ANGLE)))
            if limits.lower <= order.position <= limits.upper:
                steps = max(math.ceil(limits.lower / ANGLE), min(math.floor(limits.upper / ANGLE), steps))
            speed = min(math.ceil(limits.max_velocity / frames.SPEED), frames.MOST_SPEED)
            data = frames.pack_position(steps, speed)
        self.memory[joint].sent = self._order_of(joint, data)
        return data

    def safe_frames(self, joint: int) -> Sequence[Frame]:
        return () if self.memory[joint].sent is None else (self._frame(joint, request(RmdCommand.STOP)),)

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        joint = self._joint_of.get(can_id - REPLY_ID)
        if joint is None or len(data) != 8:
            return None
        known, command = self.memory[joint], data[0]
        if command == RmdCommand.ANGLE:
            known.position = frames.unpack_angle(data)
            return Reading(joint, known.position)
        if command == known.awaited:
            known.awaited = 0
            known.on, known.stopping = command != RmdCommand.OFF, command == RmdCommand.STOP
        temperature = velocity = torque = math.nan
        if command in frames.STATES:
            temperature, current, velocity = frames.unpack_state(data)
            torque = current * self.settings[joint].constant
            if known.asked and known.limits is not None:  # the torque of before shows whether it still makes it
                self.answered(joint, makes_torque(torque, known.torque, known.limits.max_torque))
            known.velocity, known.torque = velocity, torque
        elif command == RmdCommand.ERROR:
            temperature, known.error = frames.unpack_error(data)
        elif command == RmdCommand.RUNTIME:
            before, known.runtime = known.runtime, frames.unpack_count(data)
            if before is not None and (known.runtime - before) % 2**32 > LONGEST_PAUSE:
                known.restarted, known.on = True, None  # what it would go on with is by another zero
        elif command not in (RmdCommand.OFF, RmdCommand.STOP):
            return None
        fault = "has restarted" if known.restarted else frames.error_text(known.error)
        power = Power.FAULT if fault else self.power_shown(joint, known.stopping)
        return self.note(Reading(joint, math.nan, velocity, torque, math.nan, temperature, power, fault))

    # ---- states

    def state_request(self, joint: int) -> list[Frame]:
        self.memory[joint].asked = True
        return [self._frame(joint, request(RmdCommand.STATUS))]

    def has_restarted(self, joint: int) -> bool:
        return self.memory[joint].restarted

    def forget(self, restarts: bool = False) -> None:
        super().forget(restarts)
        for known in self.memory if restarts else ():
            known.restarted, known.runtime = False, None

    def poll(self, first: bool) -> list[Frame]:
        wanted = (RmdCommand.STATUS, RmdCommand.ANGLE)
        return [self._frame(joint, request(each)) for joint in range(self.m) for each in wanted]

    # ---- beside another host

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        joint = BROADCAST if can_id == frames.ALL_ID else self._joint_of.get(can_id - COMMAND_ID)
        if joint is None or (joint == BROADCAST and data[:1] == bytes([RmdCommand.TORQUE])):
            return None  # one current is another torque in each model
        order = self._order_of(max(joint, 0), data)
        return None if order is None else (joint, order)

    def _order_of(self, joint: int, data: bytes) -> Order | None:
        """The order that a command gives, None for what is none."""
        if len(data) != 8:
            return None
        if data[0] == RmdCommand.TORQUE:
            torque = frames.unpack_torque(data) * CURRENT * self.settings[joint].constant
            return no_order()._replace(mode=Mode.TORQUE, torque=torque, kp=0.0, kd=0.0)
        if data[0] == RmdCommand.POSITION:
            position = frames.unpack_position(data)[0] * ANGLE
            return no_order()._replace(mode=Mode.POSITION, position=position, torque=0.0, kp=0.0, kd=0.0)
        powers: dict[int, Power] = {RmdCommand.OFF: Power.OFF, RmdCommand.STOP: Power.STOPPED}
        return no_order()._replace(power=powers[data[0]]) if data[0] in powers else None


def _steps(value: float, step: float) -> int:
    """Nearest number of steps; raises ValueError for a value that is not finite."""
    if not math.isfinite(value):
        raise ValueError(f"the order is {value}: expected a finite number")
    return round(value / step)


def _watched(settings: MyActuatorSettings) -> str:
    if settings.timeout_ms:
        return (
            f"the time-out of {settings.timeout_ms} ms is taken from the arm file: it cannot be read over CAN, so "
            "check what the drive does in silence"
        )
    store = frames.timeout_command(100).hex().upper()
    return (
        "`timeout_ms` is not given in the `drive:` section: the drive keeps on with its last command after its host "
        f"died; store a time-out in the drive once (100 ms: frame {COMMAND_ID + settings.id:03X}#{store}), and state "
        "it as `timeout_ms`"
    )


def find_drives(bus: SearchedBus) -> list[FoundDrive]:
    """By the model of every id."""
    asked = [(COMMAND_ID + drive, request(RmdCommand.MODEL)) for drive in range(1, LAST_ID + 1)]
    answers = [
        (can_id - REPLY_ID, frames.unpack_model(data))
        for can_id, data in bus.gather(asked)
        if 1 <= can_id - REPLY_ID <= LAST_ID and len(data) == 8 and data[0] == RmdCommand.MODEL
    ]
    count, told = Counter(drive for drive, _ in answers), dict(answers)
    found = []
    for drive in sorted(told):
        named = frames.model_named(told[drive])
        model, rated = named or frames.MOST_TORQUE, frames.RATINGS[named][0] if named else math.nan
        note = "" if named else f"model {model} assumed: any other model makes less torque than commanded; "
        each = FoundDrive(
            *("myactuator", drive, f"id {drive}", {"id": drive, "model": model}),
            rated_torque=rated,
            max_torque=rated,
            model=told[drive],
            note=f"{note}the drive does not report its time-out: store a time-out in it (B3h), and state timeout_ms",
            answers=count[drive],
        )
        found.append(each)
    return found


SEARCH = Discovery(find_drives, ("canopen", "damiao", "moteus", "odrive"))
SUMMARY = "MyActuator RMD-X with V3 drives (protocol V3.4 to V4.2)"
FAMILY = Family("myactuator", TRAITS, MyActuatorSettings, MyActuatorDrives, discovery=SEARCH, summary=SUMMARY)
