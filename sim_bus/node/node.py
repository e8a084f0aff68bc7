"""One joint's CANopen node: object dictionary with SDO server, NMT, heartbeat both ways, EMCY (CiA 301)."""

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from canopen.objectdictionary import ODVariable
from canopen.sdo import SdoServer
from canopen.sdo.exceptions import SdoAbortedError

from armlink.drives.canopen.pdo import INVALID
from sim_bus.node.devices import Device
from sim_bus.node.object_arrays import DTYPES, Key, ObjectArrays, data_sheet, variable
from sim_bus.node.pdo import Frame, MappedPdo, layout
from sim_bus.node.torque_sensor_record import WRONG_VALUE, TorqueRecord

INITIALISING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
NO_OBJECT, NO_SUB_INDEX, READ_ONLY, WRONG_LENGTH = 0x06020000, 0x06090011, 0x06010002, 0x06070010
NOT_NOW, NOT_MAPPABLE, PDO_TOO_LONG = 0x08000022, 0x06040041, 0x06040042
SAVE, LOAD = b"save", b"load"


class Node:
    """Node `place` (from 0) of the arm, with node id `node_id`."""

    def __init__(self, place: int, node_id: int, signals: ObjectArrays, outbox: Callable[[Frame], None]) -> None:
        """A node that has not booted yet: call reset()."""
        self.place, self.node_id = place, node_id
        self.tag = 0
        """Number of its bus, as identifiers carry it (`armlink.bus.port.BUS_SHIFT`)."""
        self.object_dictionary = data_sheet()
        self.device = Device()
        self.identity: dict[Key, int | str] = {}
        """Values that differ from the EDS's defaults, kept when defaults are restored."""
        self.record = TorqueRecord()
        self.nmt = INITIALISING
        self.unplugged = False
        self.errors: list[int] = []
        self.on_write: Callable[[Key], None] = lambda key: None
        self.on_pdo_change: Callable[[], None] = lambda: None
        self._signals, self._put = signals, outbox
        self._values: dict[Key, bytes] = {}
        self._stored: dict[Key, bytes] = {}
        self._server = SdoServer(0x600 + node_id, 0x580 + node_id, self)
        self._server.network = self
        self._server._index = self._server._subindex = 0

    # ---- object dictionary

    def reset(self, communication_only: bool = False) -> None:
        """Take the stored (or default) values; send boot-up; pre-operational."""
        kept = {key: value for key, value in self._values.items() if communication_only and key[0] >= 0x2000}
        self._values = {}
        for item in data_sheet().values():
            for entry in [item] if isinstance(item, ODVariable) else item.subindices.values():
                key = (entry.index, entry.subindex)
                self._set(key, self._default(entry))
        for key, value in {**self._stored, **kept}.items():
            self._set(key, value)
        if not communication_only:
            self.record.reset()
        self._values[0x1010, 0] = b"\4"
        self.on_pdo_change()
        self.nmt = PRE_OPERATIONAL
        self.boot_up()

    def _default(self, entry: ODVariable) -> bytes:
        value: Any = self.identity.get((entry.index, entry.subindex), entry.default)
        value = 0 if value is None else value + self.node_id if entry.relative else value
        return bytes(entry.encode_raw(value))

    def _set(self, key: Key, data: bytes) -> None:
        if key in self._signals:
            signal = self._signals[key]
            signal[self.place] = np.frombuffer(data, signal.dtype)[0]
        else:
            self._values[key] = bytes(data)

    def raw(self, index: int, sub: int = 0) -> bytes:
        if (index, sub) in self._signals:
            return bytes(self._signals[index, sub][self.place].tobytes())
        if index == 0x2100:
            return bytes(8) if self.device.wide_2100 else self.record.read(sub)
        if index == 0x1003:
            return self._error_history(sub)
        return self._values[index, sub]

    def value(self, index: int, sub: int = 0) -> int:
        entry = variable(index, sub)
        assert entry is not None
        return int(np.frombuffer(self.raw(index, sub), DTYPES[entry.data_type])[0])

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:
        """SDO upload. Raises SdoAbortedError."""
        self._entry(index, subindex)
        return self.raw(index, subindex)

    def set_data(self, index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
        """SDO download. Raises SdoAbortedError."""
        entry, key = self._entry(index, subindex), (index, subindex)
        if self.device.fixed_exponent and key == (0x60C2, 2) and bytes(data) != b"\xfd":
            raise SdoAbortedError(WRONG_VALUE)
        if not entry.writable:
            raise SdoAbortedError(READ_ONLY)
        code = DTYPES.get(entry.data_type)
        if code is not None:
            if len(data) != np.dtype(code).itemsize:
                raise SdoAbortedError(WRONG_LENGTH)
            value = np.frombuffer(bytes(data), code)[0]
            if (entry.min is not None and value < entry.min) or (entry.max is not None and value > entry.max):
                raise SdoAbortedError(WRONG_VALUE)
        if index == 0x2100:
            self.record.write(subindex, bytes(data))
        elif index in (0x1010, 0x1011):
            self._store_or_restore(index, subindex, bytes(data))
        elif index == 0x1003:
            self.errors.clear()
        else:
            self._check_pdo(key, bytes(data))
            self._set(key, data)
        if 0x1400 <= index < 0x1C00:
            self.on_pdo_change()
        self.on_write(key)

    def _entry(self, index: int, sub: int) -> ODVariable:
        entry = variable(index, sub)
        absent = self.device.absent
        if entry is not None and (index, sub) in absent:
            raise SdoAbortedError(NO_SUB_INDEX if sub else NO_OBJECT)
        if index in absent or (self.device.wide_2100 and index == 0x2100 and sub > 1):
            raise SdoAbortedError(NO_OBJECT)
        if entry is None:
            raise SdoAbortedError(NO_SUB_INDEX if index in data_sheet() else NO_OBJECT)
        return entry

    def _store_or_restore(self, index: int, sub: int, data: bytes) -> None:
        if data != (SAVE if index == 0x1010 else LOAD):
            raise SdoAbortedError(0x08000020)
        if index == 0x1010:
            if sub in (1, 2, 3):
                self._stored |= {key: value for key, value in self._values.items() if _stored_by(sub, key[0])}
            if sub in (1, 4):
                self.record.store()
        else:
            self._stored = {key: value for key, value in self._stored.items() if not _stored_by(sub, key[0])}
            if sub in (1, 4):
                self.record.forget()

    def _error_history(self, sub: int) -> bytes:
        if sub == 0:
            return bytes([min(len(self.errors), 4)])
        recent = self.errors[::-1]
        return struct.pack("<I", recent[sub - 1] if sub <= len(recent) else 0)

    # ---- PDO objects

    def pdos(self, receive: bool) -> list[MappedPdo]:
        """The node's valid RPDOs or TPDOs by its objects."""
        found = []
        for number in range(4):
            communication, mapping = (
                (0x1400 + number, 0x1600 + number) if receive else (0x1800 + number, 0x1A00 + number)
            )
            entries = tuple(self.value(mapping, sub) for sub in range(1, self.value(mapping) + 1))
            cob_id, kind = self.value(communication, 1), self.value(communication, 2)
            if entries and not cob_id & INVALID:
                cob_id = self.tag | cob_id & ~0x40000000
                found.append(MappedPdo(self.place, number, cob_id, kind, entries, self._signals))
        return found

    def _check_pdo(self, key: Key, data: bytes) -> None:
        """Mapping changes only while the PDO is invalid, entries only while their number is 0 (CiA 301, 7.5.2.36)."""
        index, sub = key
        if not (0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00):
            return
        if not self.value(index - 0x200, 1) & INVALID or (sub > 0 and self.value(index) != 0):
            raise SdoAbortedError(NOT_NOW)
        count = data[0] if sub == 0 else 1
        if count > 8:
            raise SdoAbortedError(PDO_TOO_LONG)
        entries = (
            tuple(self.value(index, number) for number in range(1, count + 1))
            if sub == 0
            else tuple(entry for entry in struct.unpack("<I", data) if entry)
        )
        try:
            size = layout(entries).itemsize
        except KeyError:
            raise SdoAbortedError(NOT_MAPPABLE) from None
        if size > 8:
            raise SdoAbortedError(PDO_TOO_LONG)
        receive = index < 0x1800
        for entry in entries:
            item, mapped = variable(entry >> 16, entry >> 8 & 0xFF), (entry >> 16, entry >> 8 & 0xFF)
            if mapped in self.device.unmappable or mapped[0] in self.device.absent or mapped in self.device.absent:
                raise SdoAbortedError(NOT_MAPPABLE)
            if item is not None and receive and not item.writable:
                raise SdoAbortedError(NOT_MAPPABLE)

    # ---- services

    def boot_up(self) -> None:
        self.send(0x700 + self.node_id, b"\0")

    def send(self, can_id: int, data: bytes) -> None:
        self._put((self.tag | can_id, data))

    def on_sdo(self, data: bytes) -> None:
        if len(data) == 8 and self.nmt in (PRE_OPERATIONAL, OPERATIONAL):
            self._server.on_request(0x600 + self.node_id, bytearray(data), None)

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self.send(can_id, bytes(data))

    def emergency(self, code: int, register: int, manufacturer: bytes = b"") -> None:
        """Send an EMCY frame: error code, error register, five manufacturer-specific bytes."""
        if code:
            self.errors.append(code)
        else:
            self.errors.clear()
        self._signals[0x1001, 0][self.place] = register
        self.send(0x80 + self.node_id, struct.pack("<HB5s", code, register, manufacturer))


def _stored_by(sub: int, index: int) -> bool:
    """Whether 1010h sub-index `sub` covers the object: 1 all, 2 communication, 3 application, 4 manufacturer."""
    areas = {1: (0x1000, 0xFFFF), 2: (0x1000, 0x2000), 3: (0x6000, 0x10000), 4: (0x2000, 0x6000)}
    lowest, beyond = areas[sub]
    return lowest <= index < beyond and index not in (0x1010, 0x1011, 0x1018)
