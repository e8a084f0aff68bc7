"""Logs of raw CAN frames: Vector ASC and BLF and candump's log, as python-can writes them; and others that people have.

Those are only read: what candump prints on a terminal, PEAK's trace, python-can's CSV, and any of these packed by gzip.
Times have the microsecond resolution that the written formats keep. Frames recorded from a bus (`taps.TappedBus`) and
replayed from a log (`LogBus`) carry the same times, so that both decode to the same samples bit for bit.
"""

import gzip
import io
import math
import re
import struct
import zlib
from collections.abc import Callable, Generator, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any, Self

import can
from can.io.blf import (
    FILE_HEADER_STRUCT,
    LOG_CONTAINER,
    LOG_CONTAINER_STRUCT,
    OBJ_HEADER_BASE_STRUCT,
    ZLIB_DEFLATE,
    BLFParseError,
)

from armlink.bus.in_process import InProcessBus
from armlink.bus.message_port import as_frame, is_data
from armlink.bus.port import Frame
from armlink.content.atomic_file import FLUSH_SECONDS
from armlink.errors import BadInput, BusFault

LOG_SUFFIXES = (".asc", ".blf", ".log")
READ_SUFFIXES = (*LOG_SUFFIXES, ".trc")
PACKED = ".gz"
CSV_HEADER = "timestamp,arbitration_id"
"""Beginning of a CSV file of python-can, which has the suffix of a recording."""
PRINTED = re.compile(
    r"(\((?P<time>[^)]+)\)\s*)?(?P<channel>[^\s(]\S*)\s+((RX|TX)\s+\S+\s+\S+\s+)?(?P<id>[0-9A-F]{3}|[0-9A-F]{8})"
    r"\s+\[(?P<length>\d+)\]\s*(?P<data>remote request|([0-9A-F]{2}(\s+|$))*).*",
    re.IGNORECASE | re.DOTALL,
)
"""A line as candump prints it, without the space about it: (time) channel id [length] bytes."""
SPACING = 1e-4
"""Time from frame to frame where a log has none [s]: about that of full frames on a bus of 1 Mbit/s."""
MOST_LINE = 1 << 16
"""Characters of a line; one of a CAN FD frame has some hundreds."""
MOST_IDS = 2000
"""Identifiers that a log is remembered to hold: about all of 11 bits."""
MOST_CONTAINER = 1 << 26
"""Bytes that a container of a BLF file holds at most; Vector's and python-can's writers put 128 kB into one."""
_CONTAINER = 8192  # bytes that the BLF writer buffers
_ASC_END = "end triggerblock"
_BLF_SIZE = struct.Struct("<16xQ")  # file size as stated in the header
_BAD_CONTENT = (BLFParseError, ValueError, IndexError, TypeError, OverflowError, struct.error, zlib.error)


def is_log(path: Path) -> bool:
    """Whether a file has the suffix of a raw frame log that can be read, or the header of python-can's CSV."""
    return _kind(path) in READ_SUFFIXES or (_kind(path) == ".csv" and _has_csv_header(path))


def _kind(path: Path) -> str:
    """The suffix, without that of packing."""
    return Path(path.stem if path.suffix.lower() == PACKED else path.name).suffix.lower()


def _open_text(path: Path) -> io.TextIOBase:
    if path.suffix.lower() == PACKED:
        return gzip.open(path, "rt", encoding="utf-8", errors="replace")
    return path.open(encoding="utf-8", errors="replace")


def _has_csv_header(path: Path) -> bool:
    try:
        with _open_text(path) as stream:
            return stream.read(len(CSV_HEADER)) == CSV_HEADER
    except (OSError, EOFError):
        return False


class FrameLog:
    """Writes every message of a bus to a log; a context manager that completes the file."""

    def __init__(self, path: Path) -> None:
        """Create the file; raises BadInput for another suffix or a file that cannot be written."""
        if path.suffix.lower() not in LOG_SUFFIXES:
            raise BadInput(f"{path}: not a file name for a frame log: expected {', '.join(LOG_SUFFIXES)}")
        try:
            self._writer = can.Logger(str(path))
        except OSError as error:
            raise BadInput(f"{path}: cannot be written: {error.strerror}") from None
        if hasattr(self._writer, "max_container_size"):
            self._writer.max_container_size = _CONTAINER
        self._flushed = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._writer.stop()

    def write(self, message: can.Message, stamp: int) -> None:
        message.timestamp = stamp / 1e6
        self._writer.on_message_received(message)
        if stamp - self._flushed > FLUSH_SECONDS * 1e6:
            self._writer.file.flush()
            self._flushed = stamp


class LogBus(InProcessBus):
    """A log as a bus to listen to: each frame at its time, then silence; its clock is the log's time."""

    def __init__(self, path: Path) -> None:
        """Open the log; raises BadInput if it is none."""
        self.reader = LogReader(path)
        self.clock = self
        self.channel_info = str(path)
        self._frames = self.reader.frames()
        self._next = next(self._frames, None)
        self._time = 0.0

    @property
    def ended(self) -> bool:
        return self._next is None

    def now(self) -> float:
        return self._time

    def stamp(self) -> float:
        return self._time

    def sleep_until(self, instant: float) -> None:
        self._time = max(self._time, instant)

    def take(self, timeout: float = 0.0) -> Frame | None:
        """The next frame, however late, or None at the end of the log."""
        if self._next is None:
            self._time += max(0.0, timeout)
            return None
        stamp, can_id, data = self._next
        self._time = stamp / 1e6
        self._next = next(self._frames, None)
        return can_id, data

    def put(self, can_id: int, data: bytes) -> None:
        raise BusFault(f"{self.channel_info}: nothing can be sent to a frame log: give a bus")

    def shutdown(self) -> None:
        """Nothing to do: the file closes with its reader."""


class LogReader:
    """Reads a log as far as it is intact; `warning` then says where it is truncated or unreadable."""

    def __init__(self, path: Path) -> None:
        """Raises BadInput if the file does not exist or has another suffix."""
        if not path.is_file():
            raise BadInput(f"there is no frame log {path}: give a {', '.join(READ_SUFFIXES)} file")
        if not is_log(path):
            raise BadInput(f"{path}: not a file name of a frame log: expected {', '.join(READ_SUFFIXES)}")
        if _kind(path) == ".blf" and path.suffix.lower() == PACKED:
            raise BadInput(f"{path}: BLF files are compressed already: unpack this file first (gunzip)")
        self._path, self._timeless = path, 0
        self.count = 0
        self.ids = set[int]()
        """Identifiers of these frames, with flags; not more than `MOST_IDS`."""
        self.warning = ""
        """Where the log is truncated or unreadable, or that it has no times; empty if it is intact."""

    def frames(self) -> Iterator[tuple[int, int, bytes]]:
        """Time since the first message [µs], identifier with flags and data of each data frame."""
        first = None
        for message in self._messages():
            if not math.isfinite(message.timestamp):
                self.warning = (
                    f"truncated frame log (a time is not a number): the first {self.count} frames were loaded"
                )
                return
            stamp = round(message.timestamp * 1e6)
            first = stamp if first is None else first
            if is_data(message):
                self.count += 1
                can_id, data = as_frame(message)
                if len(self.ids) < MOST_IDS:
                    self.ids.add(can_id)
                yield stamp - first, can_id, data

    def _messages(self) -> Iterator[can.Message]:
        why = ""
        try:
            if _kind(self._path) == ".blf":
                why = yield from self._from_blf()
            else:
                why = yield from self._from_lines()
        except _BAD_CONTENT:
            why = "the rest is not readable"
        except EOFError:
            why = "the file ends early"
        except OSError as error:
            raise BadInput(f"{self._path}: cannot read it: {error.strerror or error}") from None
        if why:
            self.warning = f"truncated frame log ({why}): the first {self.count} frames were loaded"

    def _from_blf(self) -> Generator[can.Message, None, str]:
        size = self._path.stat().st_size
        with self._path.open("rb") as stream:
            stated = stream.read(_BLF_SIZE.size)
            _require_containers(stream, self._path)
            stream.seek(0)
            yield from can.BLFReader(stream)
        return "" if _BLF_SIZE.unpack(stated)[0] == size else "the file ends early"

    def _from_lines(self) -> Generator[can.Message, None, str]:
        kind = _kind(self._path)
        with _open_text(self._path) as stream:
            lines = _WholeLines(stream, self._as_logged if kind == ".log" else str)
            readers = {".asc": can.ASCReader, ".trc": can.TRCReader, ".csv": can.CSVReader}
            yield from readers.get(kind, can.CanutilsLogReader)(lines)
        if lines.cut:
            return "its last line is not complete"
        if kind == ".asc" and not lines.last.strip().lower().startswith(_ASC_END):
            return "it has no End TriggerBlock"
        return ""

    def _as_logged(self, line: str) -> str:
        """A line of candump's log: as it is, or made of what it printed for people."""
        found = PRINTED.fullmatch(line.strip())
        if found is None:
            return line
        if found["time"] is None:
            self.warning = (
                "the frame log has no times (`candump -L` writes times), so the frames are assumed to be "
                f"{1e3 * SPACING:g} ms apart"
            )
            time, self._timeless = SPACING * self._timeless, self._timeless + 1
        else:
            time = _seconds(found["time"])
        flexible = "#0" if len(found["length"]) == 2 else ""  # [08]: CAN FD
        data = "R" if found["data"].startswith("r") else flexible + "".join(found["data"].split())
        return f"({time:.6f}) {found['channel']} {found['id']}#{data}\n"


def _seconds(text: str) -> float:
    """A time as candump prints it: seconds, or date and time of day."""
    try:
        return float(text)
    except ValueError:
        return datetime.fromisoformat(text).timestamp()


def _require_containers(stream: Any, path: Path) -> None:
    """Raise BadInput where a container of a BLF file unpacks to more than any writer's; python-can unpacks it whole."""
    head = _at(stream, 0, FILE_HEADER_STRUCT.size)
    place = FILE_HEADER_STRUCT.unpack(head)[1] if len(head) == FILE_HEADER_STRUCT.size else 0
    while head := _at(stream, place, OBJ_HEADER_BASE_STRUCT.size):
        if len(head) < OBJ_HEADER_BASE_STRUCT.size or head[:4] != b"LOBJ":
            return  # said by python-can
        _, _, _, length, kind = OBJ_HEADER_BASE_STRUCT.unpack(head)
        if length > MOST_CONTAINER:
            raise BadInput(f"{path}: is damaged: an object of {length} bytes, expected at most {MOST_CONTAINER}")
        if kind == LOG_CONTAINER and _unpacks_to_more(_at(stream, place, length)[OBJ_HEADER_BASE_STRUCT.size :]):
            raise BadInput(f"{path}: is damaged: an object unpacks to more than {MOST_CONTAINER} bytes")
        place += max(length + length % 4, OBJ_HEADER_BASE_STRUCT.size)


def _unpacks_to_more(container: bytes) -> bool:
    try:
        method, _ = LOG_CONTAINER_STRUCT.unpack_from(container)
        packed = container[LOG_CONTAINER_STRUCT.size :]
        return method == ZLIB_DEFLATE and len(zlib.decompressobj().decompress(packed, MOST_CONTAINER)) == MOST_CONTAINER
    except (struct.error, zlib.error):
        return False  # said by python-can


def _at(stream: Any, place: int, count: int) -> bytes:
    stream.seek(place)
    return bytes(stream.read(count))


class _WholeLines:
    """Lines of a text file up to the first one without newline, as python-can's readers expect them."""

    def __init__(self, stream: Any, rewritten: Callable[[str], str]) -> None:
        """`rewritten` makes of a line what the reader understands."""
        self._stream, self._rewritten = stream, rewritten
        self.cut, self.last = False, ""

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> str:
        line = self._stream.readline(MOST_LINE)
        if not line:
            raise StopIteration
        if not line.endswith("\n"):
            self.cut = True
            raise StopIteration
        if line.strip():
            self.last = line
        return self._rewritten(line)

    def read(self, size: int = -1) -> str:
        """Not used; python-can requires the attribute of a file."""
        raise NotImplementedError

    def close(self) -> None:
        self._stream.close()
