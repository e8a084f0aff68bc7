"""The torque sensor's calibration record in a joint controller (manufacturer object 2100h).

| sub | type | access | |
|---|---|---|---|
| 1 | I32 | ro | reading [µN·m], `(v − offset) / gain` with the active gain and offset |
| 2, 3 | REAL32 | ro | active gain and offset [N·m]; 1 and 0 when new |
| 4, 5 | REAL32 | rw | staged gain and offset |
| 6 | U8 | rw | write 1: activate the staged record; reads 1 if staged and active record are equal |
| 7, 8 | U32 | rw | record id and date (seconds since 1970-01-01), staged with 4 and 5 |
| 9 | U32 | rw | CRC-32 (IEEE 802.3, as `zlib.crc32`) over the 16 bytes `<ffII` of 4, 5, 7 and 8 |

Writing 6 aborts with 0609 0030h if the CRC does not match, the gain is zero or a value is not finite; the active record
is then unchanged. The active record is lost at reset unless it was stored by 1010h:4 (or :1).
"""

import math
import struct
import zlib
from dataclasses import dataclass

from canopen.sdo.exceptions import SdoAbortedError

WRONG_VALUE = 0x06090030


@dataclass(frozen=True)
class SensorRecord:
    """One calibration: gain, offset [N·m], id and date [s since 1970]."""

    gain: float = 1.0
    offset: float = 0.0
    record_id: int = 0
    date: int = 0

    @property
    def content(self) -> bytes:
        return struct.pack("<ffII", self.gain, self.offset, self.record_id, self.date)


class TorqueRecord:
    """The active record, the staged one, and the one in non-volatile memory."""

    def __init__(self) -> None:
        self._kept = SensorRecord()
        self.reset()

    def reset(self) -> None:
        """Power-on: activate the stored record."""
        self.active = self._kept
        self._staged: dict[int, bytes] = dict(zip((4, 5, 7, 8), _fields(self.active), strict=True))
        self._crc = zlib.crc32(self.active.content)

    def store(self) -> None:
        self._kept = self.active

    def forget(self) -> None:
        """Store default values; the active record stays until the next reset."""
        self._kept = SensorRecord()

    def read(self, sub: int) -> bytes:
        """Bytes of a sub-index, except the reading."""
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
        record = SensorRecord(*struct.unpack("<ffII", self._content()))
        usable = math.isfinite(record.gain) and record.gain != 0.0 and math.isfinite(record.offset)
        if data != b"\1" or zlib.crc32(self._content()) != self._crc or not usable:
            raise SdoAbortedError(WRONG_VALUE)
        self.active = record


def _fields(record: SensorRecord) -> tuple[bytes, bytes, bytes, bytes]:
    content = record.content
    return content[:4], content[4:8], content[8:12], content[12:]
