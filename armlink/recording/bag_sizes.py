"""Sizes of a bag, asked before rosbags reads it: that unpacks whatever it finds, files onto the disk."""

import bz2
import struct
from pathlib import Path
from typing import Any

import lz4.frame
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from zstandard import ZstdDecompressor, ZstdError

from armlink.content.file_content import parse_yaml, read_whole
from armlink.errors import BadInput
from armlink.recording.mcap import DAMAGED, most_record, require_chunk_size
from armlink.recording.recording import PIECE, require_size

MOST_WINDOW = 1 << 27
"""Window of zstd [bytes]: what its own command allows without `--long`."""


def require_bag_sizes(path: Path) -> None:
    """Raise BadInput where a bag, by its folder or one file, unpacks to more than a recording may hold."""
    if path.is_dir():
        description = path / "metadata.yaml"
        if description.is_file():
            parse_yaml(read_whole(description), description)
        files = [each for each in path.iterdir() if each.is_file()]
    else:
        files = [path]
    for each in files:
        if each.suffix == ".zstd":
            _require_unpacked(each)
        elif each.suffix == ".mcap":
            _require_chunks(each)
        elif each.suffix == ".bag":
            _require_ros1_chunks(each)


def _require_ros1_chunks(path: Path) -> None:
    """Unpack the chunks of a ROS 1 bag piece by piece, and keep nothing; a damaged bag is told by who reads it."""
    size = 0
    unpackers: dict[bytes, Any] = {b"bz2": bz2.BZ2Decompressor, b"lz4": lz4.frame.LZ4FrameDecompressor}
    try:
        with path.open("rb") as stream:
            stream.readline()
            while len(length := stream.read(4)) == 4:
                header = _ros1_fields(stream.read(_length(length, path)))
                left = _length(stream.read(4), path)
                if header.get(b"op") != CHUNK or header.get(b"compression") not in unpackers:
                    stream.seek(left, 1)
                    continue
                unpacker, packed = unpackers[header[b"compression"]](), b""
                while not unpacker.eof and (left or not unpacker.needs_input):
                    if unpacker.needs_input:
                        packed, left = stream.read(min(left, PIECE)), max(left - PIECE, 0)
                    size += len(unpacker.decompress(packed, PIECE))
                    packed = b""
                    require_size(size, str(path))
                stream.seek(left, 1)
    except (OSError, EOFError, RuntimeError, struct.error):
        return


CHUNK = b"\x05"
"""Kind of the records of a ROS 1 bag that hold others."""


def _length(field: bytes, path: Path) -> int:
    """A length of a ROS 1 bag, of which the file must hold as much."""
    length = int(struct.unpack("<I", field)[0])
    if length > path.stat().st_size:
        raise EOFError
    return length


def _ros1_fields(header: bytes) -> dict[bytes, bytes]:
    found, at = dict[bytes, bytes](), 0
    while at + 4 <= len(header):
        (length,) = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4 : at + 4 + length].partition(b"=")
        found[name] = value
        at += 4 + length
    return found


def _require_unpacked(path: Path) -> None:
    """Unpack a file piece by piece, and keep nothing."""
    size = 0
    try:
        unpacker = ZstdDecompressor(max_window_size=MOST_WINDOW)
        with path.open("rb") as packed, unpacker.stream_reader(packed, read_across_frames=True) as stream:
            while piece := stream.read(PIECE):
                size += len(piece)
                require_size(size, str(path))
    except (ZstdError, OSError) as error:
        raise BadInput(f"{path}: cannot be unpacked: {error}") from None


def _require_chunks(path: Path) -> None:
    try:
        with path.open("rb") as stream:
            for record in StreamReader(stream, emit_chunks=True, record_size_limit=most_record(path)).records:
                if isinstance(record, Chunk):
                    require_chunk_size(record, path)
    except DAMAGED:
        return  # said by who reads it
