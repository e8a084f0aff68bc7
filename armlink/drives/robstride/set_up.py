"""Parameters of a RobStride drive: mode, torque limit and deadman set in RAM and read back."""

from collections.abc import Callable

from armlink.bus.port import EXTENDED, Frame
from armlink.drives.family import Ask
from armlink.drives.mit_packing import Ranges
from armlink.drives.mit_setup import mit_setup, require_window
from armlink.drives.orders import Limits, Setup
from armlink.drives.robstride import frames
from armlink.drives.robstride.frames import MOTION_MODE, TIMEOUT_UNIT, Feedback, RobStrideParameter, Type
from armlink.drives.robstride.settings import RobStrideSettings
from armlink.errors import BusFault

TOLERANCE = 1e-3
"""Relative difference between a float that was written and its reading."""


def identify(ask: Ask, settings: RobStrideSettings) -> str | None:
    """The 64-bit unique id, hexadecimal, or None where nothing answers."""

    def unique_id(can_id: int, data: bytes) -> str | None:
        known = can_id & EXTENDED and frames.kind_of(can_id) == Type.IDENTITY and len(data) == 8
        return data[::-1].hex().upper() if known and frames.data_of(can_id) & 0xFF == settings.id else None

    return ask(_extended(frames.identity_frame(settings.id, settings.host)), unique_id)


def read_parameter(ask: Ask, settings: RobStrideSettings, parameter: int) -> float | None:
    """Value of a parameter; None where the drive does not answer or does not have it."""

    def value(can_id: int, data: bytes) -> tuple[float | None] | None:
        found = frames.parameter_answer(can_id, data) if can_id & EXTENDED else None
        return (found[2],) if found is not None and found[:2] == (settings.id, parameter) else None

    answer = ask(_extended(frames.read_frame(settings.id, settings.host, parameter)), value)
    return None if answer is None else answer[0]


def prepare(ask: Ask, name: str, settings: RobStrideSettings, limits: Limits, ranges: Ranges) -> Setup:
    """Set-up of one drive: stopped, motion mode, torque limit, deadman, each read back. Raises BusFault, BadInput."""
    require_window(name, limits, ranges)
    feedback = ask(_extended(frames.stop_frame(settings.id, settings.host)), _feedback(settings, ranges))
    if feedback is None:
        raise BusFault(f"{name}: no answer from {settings.address}: is it powered, its id right, its protocol private?")
    most = min(limits.max_torque, ranges.torque)
    _set(ask, name, settings, RobStrideParameter.RUN_MODE, MOTION_MODE, "the drive is not in motion mode")
    _set(ask, name, settings, RobStrideParameter.LIMIT_TORQUE, most, "its own torque limit is not in force")
    deadman = round(limits.deadline / TIMEOUT_UNIT)
    _set(ask, name, settings, RobStrideParameter.TIMEOUT, deadman, "it would keep on after its host died")
    notes = (f"scales of {settings.model} by its manual: the drive has no register for them",)
    where = (f"the range of an {settings.model}",) * 3
    remedy = "the drive has no register for it: correct drive.model, or take a drive with more"
    return mit_setup(feedback.motion.position, settings.kp, settings.kd, ranges, notes, where, remedy)


def _set(
    ask: Ask, name: str, settings: RobStrideSettings, parameter: RobStrideParameter, value: float, otherwise: str
) -> None:
    ask(
        _extended(frames.write_frame(settings.id, settings.host, parameter, value)),
        _feedback(settings, frames.RANGES[settings.model]),
    )
    found = read_parameter(ask, settings, parameter)
    if found is None:
        raise BusFault(
            f"{name}: its firmware has no parameter {int(parameter):04X}h ({parameter.name}): {otherwise}; update it"
        )
    if abs(found - value) > TOLERANCE * abs(value):
        raise BusFault(
            f"{name}: parameter {int(parameter):04X}h ({parameter.name}) was set to {value:g} and reads back "
            f"{found:g}: {otherwise}"
        )


def _feedback(settings: RobStrideSettings, ranges: Ranges) -> Callable[[int, bytes], Feedback | None]:
    def feedback(can_id: int, data: bytes) -> Feedback | None:
        found = frames.unpack_feedback(can_id, data, ranges) if can_id & EXTENDED else None
        return found if found is not None and found.drive == settings.id else None

    return feedback


def _extended(frame: Frame) -> Frame:
    return frame[0] | EXTENDED, frame[1]
