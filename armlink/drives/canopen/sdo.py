"""SDO, NMT and emergencies through the `canopen` package, without its threads: the link's own loop feeds it."""

import logging
import queue
import struct
from collections import deque
from collections.abc import Callable
from typing import Any

import canopen
from canopen.sdo.exceptions import SdoAbortedError, SdoError

from armlink.drives.canopen.object_dictionary import DEVICE_TYPE, Entry
from armlink.errors import BusFault

logging.getLogger("canopen").addHandler(logging.NullHandler())

SDO_TIMEOUT = 0.3
"""Timeout of each of the SDO_TRIES [s]."""
SDO_TRIES = 3

ABSENT = (0x06020000, 0x06090011)
"""SDO abort codes: no such object, no such sub-index (CiA 301, 7.2.4.3.17)."""
MALFORMED = (struct.error, IndexError, ValueError, TypeError)
"""Exceptions that canopen's SDO client raises on malformed frames."""

RESPONSE_TO = {1: 3, 2: 2}
"""Command specifiers that begin a transfer, and those of their responses: download, upload (CiA 301, 7.2.4.3)."""
SDO_LENGTH = 8
"""Length of every SDO frame [bytes] (CiA 301, 7.2.4.3)."""

Send = Callable[[int, bytes], None]
Pump = Callable[[Callable[[], bool], float], bool]
"""Runs the receive loop until the condition holds (True) or the seconds are over (False)."""


class PumpedNetwork(canopen.Network):  # type: ignore[misc]
    """A canopen network whose frames go out through the link's port and come in through `notify`."""

    def __init__(self, send: Send) -> None:
        super().__init__(bus=None)
        self._send = send
        self._asked: dict[int, tuple[int, bytes]] = {}
        """Newest request to each node: the kind of response that it brings, and its index and sub-index."""

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        if can_id & 0x780 == 0x600 and data[0] >> 5 in RESPONSE_TO:
            self._asked[can_id & 0x7F] = (RESPONSE_TO[data[0] >> 5], bytes(data[1:4]))
        self._send(can_id, bytes(data))

    def notify(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Take in an SDO response to the newest request; other frames are ignored.

        A request that was repeated brings two responses; the second may come after the next request, and is not for it.
        canopen's handlers raise on truncated frames.
        """
        if not (0x580 < can_id < 0x600 and len(data) == SDO_LENGTH):
            return
        kind, asked = data[0] >> 5, self._asked.get(can_id & 0x7F)
        if asked is not None and kind in RESPONSE_TO.values() and asked != (kind, bytes(data[1:4])):
            return
        super().notify(can_id, data, timestamp)


class PumpedResponses:
    """Stands in for the SDO client's queue: waiting for a response runs the receive loop of the link."""

    def __init__(self, pump: Pump) -> None:
        self._pump = pump
        self._items: deque[bytes] = deque()

    def put(self, item: bytes) -> None:
        self._items.append(item)

    def empty(self) -> bool:
        """Discard late responses to an earlier request, so that the queue is empty."""
        self._items.clear()
        return True

    def get(self, block: bool = True, timeout: float = SDO_TIMEOUT) -> bytes:
        """The next response; raises queue.Empty after `timeout` seconds, which canopen expects."""
        if not self._pump(lambda: bool(self._items), timeout):
            raise queue.Empty
        return self._items.popleft()


class NodeServices:
    """SDO access to one joint's controller; every failure is a BusFault that names joint, node and object."""

    def __init__(self, network: PumpedNetwork, joint: str, node: int, dictionary: Any, pump: Pump) -> None:
        self.joint = joint
        self.node = node
        self.remote = canopen.RemoteNode(node, dictionary)
        network[node] = self.remote
        client = self.remote.sdo
        client.responses = PumpedResponses(pump)
        client.RESPONSE_TIMEOUT = SDO_TIMEOUT
        client.MAX_RETRIES = SDO_TRIES

    def present(self) -> bool:
        """Whether the node answers a read of its device type at the first try."""
        client = self.remote.sdo
        client.MAX_RETRIES = 1
        try:
            client.upload(DEVICE_TYPE.index, 0)
        except SdoAbortedError:
            return True
        except (SdoError, *MALFORMED):
            return False
        finally:
            client.MAX_RETRIES = SDO_TRIES
        return True

    def has(self, entry: Entry) -> bool:
        """Whether the device has an object; raises BusFault if it does not answer."""
        try:
            self._transfer(entry, self.remote.sdo.upload)
        except SdoAbortedError as error:
            if error.code in ABSENT:
                return False
            raise self.fault(entry, f"read refused: {error}") from None
        return True

    def read(self, entry: Entry) -> Any:
        try:
            data = bytes(self._transfer(entry, self.remote.sdo.upload))
        except SdoAbortedError as error:
            raise self.fault(entry, f"read refused: {error}") from None
        if len(data) != entry.bits // 8:
            raise self.fault(entry, f"{len(data)} bytes, expected {entry.bits // 8}")
        return struct.unpack("<" + entry.code, data)[0]

    def _transfer(self, entry: Entry, transfer: Callable[[int, int], Any]) -> Any:
        """The answer of an upload or download; raises BusFault, or SdoAbortedError if the device refuses."""
        try:
            return transfer(entry.index, entry.sub)
        except SdoAbortedError:
            raise
        except SdoError as error:
            raise self.fault(entry, f"no answer within {SDO_TRIES} × {SDO_TIMEOUT} s ({error})") from None
        except MALFORMED as error:
            raise self.fault(entry, f"malformed SDO response: {error}") from None

    def write(self, entry: Entry, value: float) -> None:
        client = self.remote.sdo
        try:
            self._transfer(entry, lambda *at: client.download(*at, struct.pack("<" + entry.code, value)))
        except SdoAbortedError as error:
            raise self.fault(entry, f"write of {value} refused: {error}") from None

    def write_checked(self, entry: Entry, value: float) -> None:
        """Set an object and read it back, bit for bit; raises BusFault."""
        self.write(entry, value)
        self.expect(entry, value)

    def expect(self, entry: Entry, value: float) -> None:
        """Read an object and compare it with `value`, bit for bit; raises BusFault."""
        held = self.read(entry)
        if struct.pack("<" + entry.code, held) != struct.pack("<" + entry.code, value):
            raise self.fault(entry, f"{value} was written, but the device holds {held}")

    def read_text(self, index: int) -> str:
        """A visible string; empty if the device does not have the object."""
        try:
            return str(self.remote.sdo.upload(index, 0).decode("ascii", "replace").rstrip("\0"))
        except (SdoError, *MALFORMED):
            return ""

    def fault(self, entry: Entry, what: str) -> BusFault:
        """A fault of this node that names joint, node and object."""
        return BusFault(f"{self.joint} (node {self.node}): {entry}: {what}")
