"""Codec of python-can's udp_multicast: one MessagePack map of a message's fields per datagram.

python-can packs the fields in a fixed order, so that only identifier, length, data and flags differ between datagrams.
Datagrams are built from cached parts and recognised by them; a map with another order or integer width is unpacked
field by field. Identifiers carry SocketCAN's flags.
"""

from functools import lru_cache
from typing import Any

import msgpack

from armlink.bus.port import ERROR, EXTENDED, REMOTE

LONGEST = 1024
"""Limit of datagrams [bytes]; python-can's have at most 240 without the name of a channel."""
HEADS_KEPT = 4096
_DEFAULTS: dict[str, Any] = {
    "timestamp": 0.0,
    "arbitration_id": 0,
    "is_extended_id": True,
    "is_remote_frame": False,
    "is_error_frame": False,
    "channel": None,
    "dlc": None,
    "data": None,
    "is_fd": False,
    "bitrate_switch": False,
    "error_state_indicator": False,
}
"""Fields of python-can's Message in the order of its packer, with their default values."""
_FLAGS = tuple(name for name, value in _DEFAULTS.items() if isinstance(value, bool))
_MOST_DATA = 64


def _key(name: str) -> bytes:
    return bytes([0xA0 | len(name)]) + name.encode()


_BOOL = (b"\xc2", b"\xc3")
_START = bytes([0x80 | len(_DEFAULTS)]) + _key("timestamp") + b"\xcb"
_HEAD = len(_START) + 8
"""Offset behind the timestamp."""
_NO_TIME = _START + bytes(8)
"""Timestamp 0, as of any message a program sends; the receiver replaces it."""
_IDENTIFIER = _HEAD + len(_key("arbitration_id"))
_WIDTHS = {0xCC: 2, 0xCD: 3, 0xCE: 5}
"""First byte of an identifier above 127 → its width [bytes]."""


def _head(can_id: int, length: int) -> bytes:
    """Datagram from identifier to length of the data, which a remote frame only asks for."""
    extended, error, remote = bool(can_id & EXTENDED), bool(can_id & ERROR), bool(can_id & REMOTE)
    return b"".join(
        (
            _key("arbitration_id") + msgpack.packb(can_id & 0x1FFFFFFF),
            _key("is_extended_id") + _BOOL[extended] + _key("is_remote_frame") + _BOOL[remote],
            _key("is_error_frame") + _BOOL[error] + _key("channel") + b"\xc0",
            _key("dlc") + bytes([length]) + _key("data") + bytes([0xC4, 0 if remote else length]),
        )
    )


def _tail(fd: bool, switch: bool, indicator: bool) -> bytes:
    """Datagram behind the data."""
    return b"".join(
        _key(name) + _BOOL[value]
        for name, value in (("is_fd", fd), ("bitrate_switch", switch), ("error_state_indicator", indicator))
    )


_BEHIND_IDENTIFIER = len(_head(0, 0)) - len(_key("arbitration_id")) - 1
_TAILS = {
    _tail(False, False, False): False,
    **{_tail(True, switch, indicator): True for switch in (False, True) for indicator in (False, True)},
}
"""Valid ends of a datagram → whether the frame is CAN FD."""
_SENT_TAILS = (_tail(False, False, False), _tail(True, True, False))


@lru_cache(maxsize=HEADS_KEPT)
def _start(can_id: int, length: int) -> bytes:
    return _NO_TIME + _head(can_id, length)


def encode(can_id: int, data: bytes, fd: bool) -> bytes:
    """Datagram of a frame, with bit-rate switch if it is CAN FD."""
    return _start(can_id, len(data)) + (b"" if can_id & REMOTE else data) + _SENT_TAILS[fd]


class Decoder:
    """Decodes datagrams; caches the parts of those it has seen."""

    def __init__(self) -> None:
        self._heads: dict[bytes, tuple[int, int]] = {}

    def decode(self, datagram: bytes) -> tuple[int, bytes, bool] | None:
        """Identifier with flags, data, and whether it is CAN FD; None for an invalid datagram."""
        if datagram.startswith(_START) and len(datagram) > _IDENTIFIER:
            end = _IDENTIFIER + _WIDTHS.get(datagram[_IDENTIFIER], 1) + _BEHIND_IDENTIFIER
            head = datagram[_HEAD:end]
            known = self._heads.get(head)
            if known is not None:
                can_id, length = known
                fd = _TAILS.get(datagram[end + length :])
                if fd is not None and (length <= 8 or fd):
                    return can_id, datagram[end : end + length], fd
            found = _unpack(datagram)
            if found is not None and not found[0] & REMOTE and head == _head(found[0], len(found[1])):
                if len(self._heads) >= HEADS_KEPT:
                    self._heads.clear()
                self._heads[head] = found[0], len(found[1])
            return found
        return _unpack(datagram)


def _unpack(datagram: bytes) -> tuple[int, bytes, bool] | None:
    """Decode any map that python-can accepts as a valid message; None for anything else."""
    try:
        fields = msgpack.unpackb(datagram, raw=False)
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException):
        return None
    if not isinstance(fields, dict) or fields.keys() - _DEFAULTS.keys() - {"is_rx"}:
        return None
    fields = _DEFAULTS | fields
    can_id, data, dlc = fields["arbitration_id"], fields["data"], fields["dlc"]
    remote, fd = fields["is_remote_frame"], fields["is_fd"]
    if data is None or remote:
        data = bytes(dlc) if remote and type(dlc) is int and 0 <= dlc <= 8 else b""
    if not (type(can_id) is int and isinstance(data, bytes) and type(dlc) in (int, type(None))):
        return None
    if any(type(fields[name]) is not bool for name in _FLAGS):
        return None
    dlc = len(data) if dlc is None else dlc
    extended, error = fields["is_extended_id"], fields["is_error_frame"]
    sound = (
        0 <= can_id < (0x20000000 if extended else 0x800)
        and 0 <= dlc <= (_MOST_DATA if fd else 8)
        and (remote or dlc == len(data))
        and not (remote and (error or fd))
        and (fd or not (fields["bitrate_switch"] or fields["error_state_indicator"]))
    )
    if not sound:
        return None
    return can_id | EXTENDED * extended | REMOTE * remote | ERROR * error, data, fd
