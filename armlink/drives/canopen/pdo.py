"""Process data objects: the link's mapping, its configuration with read-back, and the decoding table."""

import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from armlink.drives.canopen.object_dictionary import (
    CONTROL_WORD,
    MODE,
    MODE_DISPLAY,
    MOTOR_TORQUE,
    POSITION,
    STATUS_WORD,
    TARGET_POSITION,
    TARGET_TORQUE,
    TORQUE_READING,
    VELOCITY,
    Entry,
)

SYNC_TYPE = 1
"""Transmission type: RPDO applied at every SYNC, TPDO sent after it (CiA 301, 1800h:02)."""
EVENT_TYPE = 255
"""Transmission type: RPDO applied on reception, TPDO sent when its value changes."""
STATUS_DECIMATION = 4
"""TPDO2 is sent after every fourth SYNC."""

INVALID = 1 << 31
_NO_REMOTE = 1 << 30


class MappingRefused(Exception):
    """The device holds a different mapping from the one that was written."""


@dataclass(frozen=True)
class Pdo:
    name: str
    cob_base: int
    """COB-ID without the node id."""
    communication: int
    """Index of the communication record (1400h or 1800h + n)."""
    mapping: int
    """Index of the mapping record (1600h or 1A00h + n)."""
    entries: tuple[Entry, ...]
    transmission: int

    def with_entries(self, entries: tuple[Entry, ...]) -> "Pdo":
        """The same PDO with other objects in it."""
        return self if entries == self.entries else replace(self, entries=entries)

    @property
    def layout(self) -> struct.Struct:
        """The payload, little endian without padding (CiA 301)."""
        return struct.Struct("<" + "".join(entry.code for entry in self.entries))


RPDO1 = Pdo("RPDO1", 0x200, 0x1400, 0x1600, (CONTROL_WORD, TARGET_TORQUE, TARGET_POSITION), SYNC_TYPE)
RPDO2 = Pdo("RPDO2", 0x300, 0x1401, 0x1601, (MODE,), EVENT_TYPE)
TPDO1 = Pdo("TPDO1", 0x180, 0x1800, 0x1A00, (POSITION, TORQUE_READING), SYNC_TYPE)
TPDO2 = Pdo("TPDO2", 0x280, 0x1801, 0x1A01, (STATUS_WORD, MOTOR_TORQUE, VELOCITY), STATUS_DECIMATION)
TPDO3 = Pdo("TPDO3", 0x380, 0x1802, 0x1A02, (STATUS_WORD, MODE_DISPLAY), EVENT_TYPE)
LINK_PDOS = (RPDO1, RPDO2, TPDO1, TPDO2, TPDO3)
RPDO_BASES = (0x200, 0x300, 0x400, 0x500)
"""COB-IDs of the predefined RPDOs without the node id (CiA 301, 7.3.3)."""
_RPDOS = range(0x1400, 0x1600)
_ALWAYS_LOOKED_FOR = (0x1402, 0x1403)

Write = Callable[[Entry, int], None]
Read = Callable[[Entry], int]


def configure(pdo: Pdo, node: int, write: Write, read: Read, deadline_ms: int | None = 0) -> None:
    """Set one PDO of one node over SDO and read all of it back; arguments as `write_mapping`.

    Raises MappingRefused if the device does not hold what was written.
    """
    for entry, setting in write_mapping(pdo, node, write, deadline_ms):
        if entry.index == pdo.communication and entry.sub == 1:
            _same(entry, setting & ~_NO_REMOTE, read(entry) & ~_NO_REMOTE)
        else:
            _same(entry, setting, read(entry))


def write_mapping(pdo: Pdo, node: int, write: Write, deadline_ms: int | None = 0) -> list[tuple[Entry, int]]:
    """Set one PDO of one node over SDO (CiA 301 section 7.5.2.36: invalid, count 0, entries); what it must then hold.

    `deadline_ms` is the RPDO deadline or TPDO event timer (sub-index 5), 0 for none, None for a device without it.
    """
    cob_id = Entry(pdo.communication, 1, "I", f"{pdo.name} COB-ID")
    kind = Entry(pdo.communication, 2, "B", f"{pdo.name} transmission type")
    timer = Entry(pdo.communication, 5, "H", f"{pdo.name} event timer")
    count = Entry(pdo.mapping, 0, "B", f"{pdo.name} number of mapped objects")
    value = pdo.cob_base + node | (_NO_REMOTE if pdo.communication >= 0x1800 else 0)
    settings = [(kind, pdo.transmission)]
    if deadline_ms is not None:
        settings.append((timer, deadline_ms))
    settings += [
        (Entry(pdo.mapping, i, "I", f"{pdo.name} mapping {i}"), entry.mapping) for i, entry in enumerate(pdo.entries, 1)
    ]
    write(cob_id, value | INVALID)
    write(count, 0)
    for entry, setting in settings:
        write(entry, setting)
    write(count, len(pdo.entries))
    write(cob_id, value)
    return [*settings, (count, len(pdo.entries)), (cob_id, value)]


def try_mapping(pdo: Pdo, node: int, write: Write) -> None:
    """Write the mapping of one PDO, which stays invalid; raises what `write` raises where the device refuses it."""
    write(Entry(pdo.communication, 1, "I", f"{pdo.name} COB-ID"), pdo.cob_base + node | INVALID)
    write(Entry(pdo.mapping, 0, "B", f"{pdo.name} number of mapped objects"), 0)
    for i, entry in enumerate(pdo.entries, 1):
        write(Entry(pdo.mapping, i, "I", f"{pdo.name} mapping {i}"), entry.mapping)


def foreign_rpdos(described: Iterable[int]) -> list[int]:
    """Communication records of RPDOs that the link does not use: the predefined ones and those in a data sheet."""
    ours = {RPDO1.communication, RPDO2.communication}
    return sorted({*_ALWAYS_LOOKED_FOR, *(index for index in described if index in _RPDOS)} - ours)


def disable(index: int, write: Write, read: Read) -> None:
    """Set the RPDO whose communication record is `index` invalid; raises MappingRefused if it stays valid."""
    cob_id = Entry(index, 1, "I", f"RPDO{index - _RPDOS.start + 1} COB-ID")
    held = read(cob_id)
    if not held & INVALID:
        write(cob_id, held | INVALID)
        if not read(cob_id) & INVALID:
            raise MappingRefused(
                f"{cob_id}: stays valid, so another program could command this joint through this RPDO"
            )


def _same(entry: Entry, written: int, held: int) -> None:
    if held != written:
        raise MappingRefused(
            f"{entry}: {written:#x} was written, but the device holds {held:#x}: it does not accept this mapping"
        )
