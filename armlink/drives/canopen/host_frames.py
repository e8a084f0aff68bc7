"""Frames that only the host of some nodes sends: from anybody else they are a second host."""

from armlink.drives.canopen.object_dictionary import HEARTBEAT_ID, LSS_ID, NMT_ID, SDO_REQUEST_ID, SYNC_ID
from armlink.drives.canopen.pdo import RPDO_BASES

_DOWNLOADS = (1, 6)
"""Command specifiers of SDO requests that write: initiate download, block download (CiA 301, 7.2.4.3)."""
_HARMLESS_WRITES = (0x1010, 0x2100)
"""Objects that another program may write: they store settings or hold the torque sensor's calibration."""


class HostFrames:
    """Describes a frame of the host; everything else, and an SDO request that only reads, has no description."""

    def __init__(self, nodes: tuple[int, ...], host: int) -> None:
        """`nodes` are the joints' node ids, `host` our own, whose heartbeat nobody else may send."""
        self._by_id = {
            NMT_ID: "NMT command",
            SYNC_ID: "SYNC",
            LSS_ID: "LSS command",
            HEARTBEAT_ID + host: "heartbeat of the host",
            **{base + node: f"RPDO{k} of node {node}" for k, base in enumerate(RPDO_BASES, 1) for node in nodes},
        }
        self._sdo = {SDO_REQUEST_ID + node: node for node in nodes}

    def __call__(self, can_id: int, data: bytes) -> str:
        """Description of a frame that only the host may send, or an empty text."""
        return self._by_id.get(can_id) or (self._written(can_id, data) if can_id in self._sdo else "")

    def _written(self, can_id: int, data: bytes) -> str:
        if len(data) < 4 or data[0] >> 5 not in _DOWNLOADS:
            return ""
        index = int.from_bytes(data[1:3], "little")
        return "" if index in _HARMLESS_WRITES else f"SDO write of {index:04X}h to node {self._sdo[can_id]}"
