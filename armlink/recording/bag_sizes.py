"""Sizes of a ROS 2 bag, asked before rosbags reads it: that unpacks whatever it finds, files onto the disk."""

from pathlib import Path

from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from zstandard import ZstdDecompressor, ZstdError

from armlink.content.file_content import MOST_YAML, parse_yaml, read_whole
from armlink.errors import BadInput
from armlink.recording.mcap import DAMAGED, most_record, require_chunk_size
from armlink.recording.recording import require_size

MOST_WINDOW = 1 << 27
"""Window of zstd [bytes]: what its own command allows without `--long`."""
PIECE = 1 << 20


def require_bag_sizes(path: Path) -> None:
    """Raise BadInput where a bag, by its folder or one file, unpacks to more than a recording may hold."""
    if path.is_dir():
        description = path / "metadata.yaml"
        if description.is_file():
            parse_yaml(read_whole(description, MOST_YAML), description)
        files = [each for each in path.iterdir() if each.is_file()]
    else:
        files = [path]
    for each in files:
        if each.suffix == ".zstd":
            _require_unpacked(each)
        elif each.suffix == ".mcap":
            _require_chunks(each)


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
