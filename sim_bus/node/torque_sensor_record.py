"""The torque sensor's calibration record in a joint controller (manufacturer object 2100h).

| sub | type | access | |
|---|---|---|---|
| 1 | I32 | ro | reading [µN·m], `(v − offset) / gain` with the gain and offset in force |
| 2, 3 | REAL32 | ro | gain and offset [N·m] in force; 1 and 0 when new |
| 4, 5 | REAL32 | rw | staged gain and offset |
| 6 | U8 | rw | write 1: the staged record comes into force; reads 1 where staged and in force are the same |
| 7, 8 | U32 | rw | record id and date (seconds since 1970-01-01), staged with 4 and 5 |
| 9 | U32 | rw | CRC-32 (IEEE 802.3, as `zlib.crc32`) over the 16 bytes `<ffII` of 4, 5, 7 and 8 |

Writing 6 aborts with 0609 0030h where the CRC does not match, the gain is zero or a value is not finite; what is in
force then stays. A record in force is lost at reset unless 1010h:4 (or :1) has stored it.
"""

import math
import struct
import zlib
from dataclasses import dataclass

from canopen.sdo.exceptions import SdoAbortedError

WRONG_VALUE = 0x06090030


@dataclass(frozen=True)
class Record:
    """One calibration: gain, offset [N·m], id and date [s since 1970]."""

    gain: float = 1.0
    offset: float = 0.0
    record_id: int = 0
    date: int = 0

    @property
    def content(self) -> bytes:
        """What the CRC covers."""
        return struct.pack("<ffII", self.gain, self.offset, self.record_id, self.date)


class TorqueRecord:
    """The record in force, the staged one, and the one in non-volatile memory."""

    def __init__(self) -> None:
        """A new controller's."""
        self._kept = Record()
        self.reset()

    def reset(self) -> None:
        """Power-on: what is kept comes into force."""
        self.active = self._kept
        self._staged: dict[int, bytes] = dict(zip((4, 5, 7, 8), _fields(self.active), strict=True))
        self._crc = zlib.crc32(self.active.content)

    def store(self) -> None:
        """Keep what is in force over a reset."""
        self._kept = self.active

    def forget(self) -> None:
        """Keep a new controller's record; what is in force stays until the next reset."""
        self._kept = Record()

    def read(self, sub: int) -> bytes:
        """The bytes of a sub-index other than the reading."""
        if sub == 0:
            return b"\x09"
        if sub == 6:
            return bytes([self._content() == self.active.content])
        if sub == 9:
            return struct.pack("<I", self._crc)
        return {2: _fields(self.active)[0], 3: _fields(self.active)[1], **self._staged}[sub]

    def write(self, sub: int, data: bytes) -> None:
        """Stage a value, or activate. Raises SdoAbortedError."""
        if sub == 9:
            self._crc = struct.unpack("<I", data)[0]
        elif sub == 6:
            self._activate(data)
        else:
            self._staged[sub] = data

    def _content(self) -> bytes:
        return b"".join(self._staged[sub] for sub in (4, 5, 7, 8))

    def _activate(self, data: bytes) -> None:
        record = Record(*struct.unpack("<ffII", self._content()))
        usable = math.isfinite(record.gain) and record.gain != 0.0 and math.isfinite(record.offset)
        if data != b"\1" or zlib.crc32(self._content()) != self._crc or not usable:
            raise SdoAbortedError(WRONG_VALUE)
        self.active = record


def _fields(record: Record) -> tuple[bytes, bytes, bytes, bytes]:
    content = record.content
    return content[:4], content[4:8], content[8:12], content[12:]
