"""Small files that become large in memory, and what no recording has: refused in one line, read no further."""

import gzip
import json
import struct
import zlib

import lz4.frame
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from armlink.errors import BadInput
from armlink.recording import mcap, parquet, recording, tables
from armlink.recording.files import load_recording, save_recording
from armlink.recording.recording import Recording

ROW = "\n0,0,0\n1,0,0\n"


def refused(path, says):
    with pytest.raises(BadInput, match=says) as caught:
        load_recording(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("index", ["999999999", "65", "9" * 5000])
def test_a_joint_number_beyond_any_arm(tmp_path, index):
    (tmp_path / "r.csv").write_text(f"t,tau_1,q_{index}{ROW}")
    refused(tmp_path / "r.csv", "of joint 999999999, expected at most 64|of joint 65|column q_1 is missing")


@pytest.mark.parametrize("column", ["q_²", "q_٣", "q_１", "q_0", "q_01", "q_-1"])
def test_a_joint_number_is_of_plain_digits(tmp_path, column):
    (tmp_path / "r.csv").write_text(f"t,tau_1,{column}{ROW}", encoding="utf-8")
    refused(tmp_path / "r.csv", "column q_1 is missing")


def test_more_columns_than_any_recording_has(tmp_path):
    (tmp_path / "r.csv").write_text("t," + ",".join(f"x{i}" for i in range(2000)) + ROW)
    refused(tmp_path / "r.csv", "2001 columns, expected at most 1000")
    (tmp_path / "r.csv").write_text("t," + ",".join(f"column_{i}" for i in range(400_000)) + ROW)
    refused(tmp_path / "r.csv", "its header row has more than 256 kB")


def test_what_unpacks_to_much_more_is_unpacked_no_further(tmp_path, monkeypatch):
    path = tmp_path / "r.csv.gz"
    monkeypatch.setattr(tables, "_SURELY_MUCH", 1 << 20)
    monkeypatch.setattr(tables, "PIECE_BYTES", 1 << 16)
    path.write_bytes(gzip.compress(b"t,q_1,tau_1\n" + b"0,0,0\n" * 5_000_000))
    pieces = []
    real = zlib.decompressobj

    class Counted:
        def __init__(self, **options):
            self._real = real(**options)

        def decompress(self, *given):
            pieces.append(1)
            return self._real.decompress(*given)

        def __getattr__(self, name):
            return getattr(self._real, name)

    monkeypatch.setattr(zlib, "decompressobj", Counted)
    refused(path, "unpacks to more than 200 times its size")
    assert len(pieces) < 2_000_000 * 30 / (1 << 16) / 2


def test_a_file_larger_than_a_recording_may_be(tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "MOST_BYTES", 500)
    t = np.arange(100.0)
    data = Recording(t=t, position=np.zeros((100, 1)), torque=np.zeros((100, 1)))
    for suffix in (".csv", ".csv.gz", ".parquet", ".mcap"):
        save_recording(data, tmp_path / f"r{suffix}")
        refused(tmp_path / f"r{suffix}", "holds more than .* GB: split it")


@pytest.mark.parametrize("content", [b"{", b"[" * 100_000, b"\xff", b"3", b'{"a": 1}', b"[1, 2]"])
def test_metadata_that_are_no_names(tmp_path, content):
    table = pa.table({name: [0.0, 1.0] for name in ("t", "q_1", "tau_1")})
    pq.write_table(table.replace_schema_metadata({parquet.NAMES_KEY: content}), tmp_path / "r.parquet")
    refused(tmp_path / "r.parquet", "armlink.names is no JSON list of joint names")
    good = table.replace_schema_metadata({parquet.NAMES_KEY: json.dumps(["a"]).encode()})
    pq.write_table(good, tmp_path / "r.parquet")
    assert load_recording(tmp_path / "r.parquet").names == ("a",)


def chunked(path, compression):
    """A recording whose messages are in chunks packed so."""
    t = np.arange(200) * 0.01
    data = Recording(t=t, position=np.zeros((200, 1)), torque=np.ones((200, 1)), names=("a",))
    real, mcap.Writer = mcap.Writer, lambda stream: Writer(stream, compression=compression, chunk_size=2000)
    try:
        save_recording(data, path)
    finally:
        mcap.Writer = real
    return path.read_bytes()


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.ZSTD, CompressionType.NONE])
def test_every_kind_of_chunk_loads_and_a_damaged_one_ends_the_recording(tmp_path, compression):
    path = tmp_path / "r.mcap"
    content = bytearray(chunked(path, compression))
    assert load_recording(path).t.size == 200
    magic = {CompressionType.LZ4: b"\x04\x22\x4d\x18", CompressionType.ZSTD: b"\x28\xb5\x2f\xfd"}.get(compression)
    place = content.rindex(magic) + 20 if magic else len(content) // 2
    content[place : place + 40] = bytes(40)
    path.write_bytes(content)
    loaded = load_recording(path)
    assert 2 <= loaded.t.size < 200
    assert "truncated recording" in loaded.warning


@pytest.mark.parametrize("pack", [lz4.frame.compress, zstandard.compress])
def test_a_chunk_that_says_less_than_it_unpacks_to(tmp_path, pack):
    bomb = pack(bytes(50_000_000))
    name = b"lz4" if pack is lz4.frame.compress else b"zstd"
    packed = (
        struct.pack("<QQQI", 0, 0, 100, 0) + struct.pack("<I", len(name)) + name + struct.pack("<Q", len(bomb)) + bomb
    )
    begin = b"\x89MCAP0\r\n" + b"\x01" + struct.pack("<Q", 8) + struct.pack("<II", 0, 0)
    (tmp_path / "r.mcap").write_bytes(begin + b"\x06" + struct.pack("<Q", len(packed)) + packed)
    refused(tmp_path / "r.mcap", "no sensor_msgs/msg/JointState on /joint_states; truncated recording")
    much = struct.pack("<QQQI", 0, 0, 1 << 40, 0) + packed[28:]
    (tmp_path / "r.mcap").write_bytes(begin + b"\x06" + struct.pack("<Q", len(much)) + much)
    refused(tmp_path / "r.mcap", "a chunk unpacks to 1099512 MB, expected at most")


@pytest.mark.parametrize("inside", [False, True])
def test_a_name_of_a_message_type_is_not_run_as_a_program(tmp_path, monkeypatch, inside):
    """rosbags makes Python source of message definitions; it takes nothing but names for names."""
    monkeypatch.chdir(tmp_path)
    hostile = 'A(__import__("pathlib").Path("made").touch() or object)'
    name, text = ("pkg/msg/A", f"pkg/B b\n{'=' * 80}\nMSG: {hostile}\nint8 x") if inside else (hostile, "int8 x")
    with (tmp_path / "r.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema(name, "ros2msg", text.encode())
        channel = writer.register_channel("/anything", "cdr", schema)
        writer.add_message(channel, 0, b"\x00\x01\x00\x00\x01", 0)
        writer.finish()
    refused(tmp_path / "r.mcap", "cannot read the bag")
    assert not (tmp_path / "made").exists()
