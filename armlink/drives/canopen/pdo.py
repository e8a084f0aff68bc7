"""Process data objects: the link's mapping, its configuration with read-back, and the decoding table."""

import struct
from collections.abc import Iterable
from dataclasses import dataclass

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
from armlink.drives.canopen.sdo import NodeServices
from armlink.errors import BusFault

SYNC_TYPE = 1
"""Transmission type: RPDO applied at every SYNC, TPDO sent after it (CiA 301, 1800h:02)."""
EVENT_TYPE = 255
"""Transmission type: RPDO applied on reception, TPDO sent when its value changes."""
STATUS_DECIMATION = 4
"""TPDO2 is sent after every fourth SYNC."""

INVALID = 1 << 31
_NO_REMOTE = 1 << 30


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


def mapping_writes(pdo: Pdo, node: int, deadline_ms: int | None = 0) -> list[tuple[Entry, int]]:
    """The writes that set one PDO of one node (CiA 301 section 7.5.2.36): invalid, count 0, settings, entries, valid.

    `deadline_ms` is the RPDO deadline or TPDO event timer (sub-index 5), 0 for none, None for a device without it.
    """
    cob_id = Entry(pdo.communication, 1, "I", f"{pdo.name} COB-ID")
    count = Entry(pdo.mapping, 0, "B", f"{pdo.name} number of mapped objects")
    value = pdo.cob_base + node | (_NO_REMOTE if pdo.communication >= 0x1800 else 0)
    settings = [(Entry(pdo.communication, 2, "B", f"{pdo.name} transmission type"), pdo.transmission)]
    if deadline_ms is not None:
        settings.append((Entry(pdo.communication, 5, "H", f"{pdo.name} event timer"), deadline_ms))
    settings += [
        (Entry(pdo.mapping, i, "I", f"{pdo.name} mapping {i}"), entry.mapping) for i, entry in enumerate(pdo.entries, 1)
    ]
    return [(cob_id, value | INVALID), (count, 0), *settings, (count, len(pdo.entries)), (cob_id, value)]


def configure(services: NodeServices, pdo: Pdo, deadline_ms: int | None) -> None:
    """Set one PDO of a node and read all of it back; raises BusFault naming joint and object."""
    writes = mapping_writes(pdo, services.node, deadline_ms)
    for entry, setting in writes:
        services.write(entry, setting)
    for entry, setting in writes[2:]:
        held = services.read(entry)
        told_apart = ~_NO_REMOTE if (entry.index, entry.sub) == (pdo.communication, 1) else ~0
        if (held ^ setting) & told_apart:
            raise services.fault(
                entry, f"{setting:#x} was written, but the device holds {held:#x}: it does not accept this mapping"
            )


def accepts_mapping(services: NodeServices, pdo: Pdo) -> bool:
    """Whether a device maps the objects of a PDO, by trying it; the PDO is left invalid."""
    invalid, *writes = mapping_writes(pdo, services.node)
    try:
        for entry, setting in (invalid, *(each for each in writes[:-2] if each[0].index == pdo.mapping)):
            services.write(entry, setting)
    except BusFault:
        return False
    return True


def disable_others(services: NodeServices) -> None:
    """Set every RPDO invalid that is not the link's, as another program could move the joint through it.

    Raises BusFault naming joint and object.
    """
    for index in foreign_rpdos(services.remote.object_dictionary):
        cob_id = Entry(index, 1, "I", f"RPDO{index - _RPDOS.start + 1} COB-ID")
        if not services.has(cob_id) or (held := services.read(cob_id)) & INVALID:
            continue
        services.write(cob_id, held | INVALID)
        if not services.read(cob_id) & INVALID:
            raise services.fault(cob_id, "stays valid, so another program could command this joint through this RPDO")


def foreign_rpdos(described: Iterable[int]) -> list[int]:
    """Communication records of RPDOs that the link does not use: the predefined ones and those in a data sheet."""
    ours = {RPDO1.communication, RPDO2.communication}
    return sorted({*_ALWAYS_LOOKED_FOR, *(index for index in described if index in _RPDOS)} - ours)
