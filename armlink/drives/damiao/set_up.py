"""Registers of a Damiao drive: reading the scales, setting mode and deadman in RAM, reading back."""

import math
from collections.abc import Callable, Iterable

from armlink.drives.damiao import frames
from armlink.drives.damiao.frames import READ, TIMEOUT_UNIT, WRITE, DamiaoRegister, DamiaoStatus
from armlink.drives.damiao.settings import DamiaoSettings
from armlink.drives.family import Ask
from armlink.drives.mit_packing import Ranges, Special, special
from armlink.drives.mit_setup import mit_setup, require_window
from armlink.drives.orders import Limits, Setup
from armlink.errors import BadInput, BusFault

SCALES = (DamiaoRegister.POSITION_RANGE, DamiaoRegister.VELOCITY_RANGE, DamiaoRegister.TORQUE_RANGE)
RANGE_REMEDY = "write it with the maker's tool and store it"
LARGEST_RANGE = 1e4
"""No range of a real drive is larger [rad, rad/s, N·m]."""
NOTED = (
    DamiaoRegister.TORQUE_CONSTANT,
    DamiaoRegister.OVER_CURRENT,
    DamiaoRegister.LARGEST_CURRENT,
    DamiaoRegister.GEAR_RATIO,
)


def read_registers(ask: Ask, drive: int, registers: Iterable[int]) -> dict[int, float | None]:
    """Values of registers of the drive with command id `drive`, None where it does not answer."""
    found: dict[int, float | None] = {}
    for register in registers:
        request = (frames.REGISTERS_ID, frames.read_request(drive, register))
        found[register] = ask(request, _answer(drive, READ, register))
        if found[register] is None:
            return found | dict.fromkeys(set(registers) - set(found))
    return found


def prepare(ask: Ask, name: str, settings: DamiaoSettings, limits: Limits) -> tuple[Ranges, Setup]:
    """Ranges of one drive by its registers, and its set-up: off, MIT mode, deadman, both read back.

    Raises BusFault, BadInput.
    """
    drive = settings.id
    ask.send(drive, special(Special.DISABLE))
    values = read_registers(ask, drive, (*SCALES, DamiaoRegister.REPLY_ID, *NOTED))
    if None in values.values():
        raise BusFault(f"{name}: no answer from {settings.address}: is it powered, and its id right?")
    known = {register: float(value or 0.0) for register, value in values.items()}
    if known[DamiaoRegister.REPLY_ID] != settings.reply:
        raise BadInput(
            f"{name}: its drive replies on id {int(known[DamiaoRegister.REPLY_ID]):02X}h (register 7), "
            f"the arm file says reply: {settings.reply:#04x}"
        )
    ranges = _ranges(name, known)
    require_window(name, limits, ranges, " (register 21)")
    _set(ask, name, drive, DamiaoRegister.CONTROL_MODE, frames.MIT_MODE, "the drive is not in MIT mode")
    deadman = round(limits.deadline / TIMEOUT_UNIT)
    _set(ask, name, drive, DamiaoRegister.TIMEOUT, deadman, "it would keep on after its host died")
    return ranges, _result(ask, name, settings, ranges, known)


def _ranges(name: str, values: dict[int, float]) -> Ranges:
    for register in SCALES:
        if not 0.0 < values[register] < LARGEST_RANGE:
            raise BusFault(f"{name}: register {int(register)} ({register.name}) is {values[register]}: no usable scale")
    return Ranges(*(values[register] for register in SCALES))


def _set(ask: Ask, name: str, drive: int, register: DamiaoRegister, value: int, otherwise: str) -> None:
    """Write a register in RAM and read it back. Raises BusFault."""
    request = (frames.REGISTERS_ID, frames.write_request(drive, register, value))
    ask(request, _answer(drive, WRITE, register))
    found = read_registers(ask, drive, (register,))[register]
    if found != value:
        raise BusFault(
            f"{name}: register {int(register)} ({register.name}) was set to {value} and reads back {found}: {otherwise}"
        )


def _result(ask: Ask, name: str, settings: DamiaoSettings, ranges: Ranges, known: dict[int, float]) -> Setup:
    reply = _state(ask, settings, ranges)
    if reply is None:
        raise BusFault(f"{name}: {settings.address} answers registers, but sends no feedback")
    if reply.state == DamiaoStatus.ENABLED:
        raise BusFault(f"{name}: {settings.address} stays enabled although it was commanded to disable")
    constant = known[DamiaoRegister.TORQUE_CONSTANT]
    notes = [
        f"torque constant {constant:g} N·m/A"
        if constant
        else "torque constant register reads 0: its meaning is unknown",
        f"gear {known[DamiaoRegister.GEAR_RATIO]:g}",
        f"current limit {known[DamiaoRegister.OVER_CURRENT] * known[DamiaoRegister.LARGEST_CURRENT]:g} A",
    ]
    where = ("register 21 (PMAX)", "register 22 (VMAX)", "register 23 (TMAX)")
    return mit_setup(reply.feedback.position, settings.kp, settings.kd, ranges, notes, where, RANGE_REMEDY)


def read_position(ask: Ask, name: str, settings: DamiaoSettings) -> float:
    """Position of one drive by its own range [rad], NaN where it does not answer or has no usable range."""
    values = read_registers(ask, settings.id, SCALES)
    if None in values.values():
        return math.nan
    try:
        reply = _state(
            ask, settings, _ranges(name, {register: float(value or 0.0) for register, value in values.items()})
        )
    except BusFault:
        return math.nan
    return math.nan if reply is None else reply.feedback.position


def _state(ask: Ask, settings: DamiaoSettings, ranges: Ranges) -> frames.DamiaoReply | None:
    """Feedback that is asked for; None where none comes."""

    def state_of(can_id: int, data: bytes) -> frames.DamiaoReply | None:
        if can_id != settings.reply or frames.register_answer(data, settings.id) is not None:
            return None
        reply = frames.unpack_reply(data, ranges)
        return reply if reply is not None and reply.drive == settings.id & 0xF else None

    return ask((frames.REGISTERS_ID, frames.refresh_request(settings.id)), state_of)


def _answer(drive: int, kind: int, register: int) -> Callable[[int, bytes], float | None]:
    def answer(can_id: int, data: bytes) -> float | None:
        found = frames.register_answer(data, drive)
        if found is None or found[:2] != (kind, register) or not math.isfinite(found[2]):
            return None
        return found[2]

    return answer
