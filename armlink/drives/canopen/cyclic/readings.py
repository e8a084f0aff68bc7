"""Frames of the joints become readings: TPDO1 to TPDO3 and emergencies; and readings become TPDOs, for a replay."""

import math
from collections.abc import Callable, Sequence
from functools import partial

from armlink.bus.port import Frame
from armlink.drives.board import Board, DriveEvent
from armlink.drives.canopen import emcy, faults
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.cyclic.commands import SYNC
from armlink.drives.canopen.cyclic.wire import Wire
from armlink.drives.canopen.faults import JointStates
from armlink.drives.canopen.pdo import TPDO1, TPDO2, TPDO3
from armlink.drives.orders import Reading


class ReadingFrames:
    """Readings by the frames of m joints, written to the `known` states and to the link's board."""

    def __init__(self, known: JointStates) -> None:
        """Nothing is decoded before `use`."""
        self._known = known
        self._wires: Sequence[Wire] = ()
        self._rows: list[tuple[int, Callable[[bytes], tuple[int, ...]], float, float, float]] = []
        self._board: Board | None = None
        self._places: Sequence[int] = range(len(known.names))

    def use(self, wires: Sequence[Wire]) -> None:
        self._wires, self._rows = wires, []
        for wire in wires:
            profile, layout = wire.profile, wire.layouts[TPDO1.name]
            scale = 0.0 if profile.reading is None else profile.torque_scale
            self._rows.append((layout.size, layout.unpack, wire.unit.position, scale, profile.torque_zero))

    def fill(self, board: Board, places: Sequence[int]) -> dict[int, Callable[[bytes], None]]:
        """Takers of the payload of each identifier: values go to the board, joint 0 … m−1 at its place there."""
        self._board, self._places = board, places
        table: dict[int, Callable[[bytes], None]] = {}
        for joint, wire in enumerate(self._wires):
            table[TPDO1.cob_base + wire.node] = partial(self._take_reading, joint, places[joint], board)
            table[TPDO2.cob_base + wire.node] = partial(self._take_slow, joint, places[joint], board)
            table[TPDO3.cob_base + wire.node] = partial(self._take_display, joint, places[joint], board)
        return table

    def take_status(self, joint: int, status: int) -> None:
        """A status word that was read otherwise than by a TPDO."""
        self._known.statuses[joint] = status
        if self._board is not None:
            self._board.status[self._places[joint]] = status

    def _take_reading(self, joint: int, place: int, board: Board, data: bytes) -> None:
        size, unpack, unit, scale, zero = self._rows[joint]
        if len(data) != size:
            board.errors += 1
        elif scale:
            position, torque = unpack(data)
            self._known.positions[joint] = seen = position * unit
            board.reading(place, seen, (torque - zero) * scale)
        else:
            self._known.positions[joint] = seen = unpack(data)[0] * unit
            board.reading(place, seen, math.nan)

    def _take_slow(self, joint: int, place: int, board: Board, data: bytes) -> None:
        slow = self._slow(joint, data)
        if slow is None:
            board.errors += 1
        else:
            self._known.statuses[joint] = board.status[place] = slow[0]
            board.slow(place, slow[1], slow[2])

    def _take_display(self, joint: int, place: int, board: Board, data: bytes) -> None:
        layout = self._wires[joint].layouts[TPDO3.name]
        if len(data) != layout.size:
            board.errors += 1
            return
        values = layout.unpack(data)
        self._known.statuses[joint] = board.status[place] = values[0]
        if len(values) == 2:
            self._known.displays[joint] = values[1]

    def take_emergency(self, joint: int, data: bytes) -> None:
        """An EMCY message; the end of an error (code 0) is not kept."""
        code, register = emcy.parse(data)
        if not code:
            return
        self._known.emergencies.append((joint, code, register))
        if self._board is not None:
            evidence = {"code": code, "register": register}
            self._board.events.append(DriveEvent(self._places[joint], f"{code:04X}h", emcy.name_of(code), evidence))

    def _slow(self, joint: int, data: bytes) -> tuple[int, float, float] | None:
        """Status word, motor torque and velocity of TPDO2; None where the bytes are too few or too many."""
        wire = self._wires[joint]
        layout, unit = wire.layouts[TPDO2.name], wire.unit
        if len(data) != layout.size:
            return None
        values = layout.unpack(data)
        if len(values) == 3:
            return values[0], values[1] * unit.torque, values[2] * unit.velocity
        told = dict(zip(wire.entries[TPDO2.name], values, strict=True))
        motor, velocity = told.get(objects.MOTOR_TORQUE, math.nan), told.get(objects.VELOCITY, math.nan)
        return values[0], motor * unit.torque, velocity * unit.velocity

    def replayed(self, first: bool, readings: Sequence[Reading]) -> list[Frame]:
        """SYNC and TPDO1, TPDO2 if its values are there; the joints are enabled, in no mode."""
        frames = [SYNC]
        for reading in readings:
            wire = self._wires[reading.joint]
            node, unit, profile = wire.node, wire.unit, wire.profile
            if math.isfinite(reading.position) and (profile.reading is None or math.isfinite(reading.sensor_torque)):
                counts = [_whole(reading.position / unit.position, 31)]
                if profile.reading is not None:
                    counts.append(_whole(reading.sensor_torque / profile.torque_scale + profile.torque_zero, 31))
                frames.append((TPDO1.cob_base + node, wire.layouts[TPDO1.name].pack(*counts)))
            if first:
                frames.append((TPDO3.cob_base + node, TPDO3.layout.pack(faults.ENABLED_BITS, 0)))
            if math.isfinite(reading.motor_torque) and math.isfinite(reading.velocity):
                motor = _whole(reading.motor_torque / unit.torque, 15)
                velocity = _whole(reading.velocity / unit.velocity, 31)
                frames.append((TPDO2.cob_base + node, TPDO2.layout.pack(faults.ENABLED_BITS, motor, velocity)))
        return frames


def _whole(value: float, bits: int) -> int:
    return max(-(1 << bits), min((1 << bits) - 1, round(value)))
