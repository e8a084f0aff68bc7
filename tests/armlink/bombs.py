"""Small files that become large in memory, of every kind that is read; run as a program, it reads some of them.

Prints as a line of JSON what came of each, and the peak of its memory until then [MB].
"""

import gzip
import json
import struct
import sys
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zstandard

GIANT = 1 << 30


def gzipped_csv(folder: Path) -> Path:
    """Two bytes of text a number: gigabytes as text, four times as many as numbers."""
    path = folder / "run.csv.gz"
    columns = ["t", *(f"{c}_{i}" for c in ("q", "tau") for i in range(1, 8))]
    header, block = ",".join(columns) + "\n", (",".join("0" * len(columns)) + "\n") * 100_000
    path.write_bytes(gzip.compress(header.encode()) + 700 * gzip.compress(block.encode(), 1))
    return path


def parquet_of_one_number(folder: Path) -> Path:
    """A dictionary of one value, repeated."""
    path = folder / "run.parquet"
    column = pa.array(np.zeros(40_000_000))
    pq.write_table(
        pa.table(dict.fromkeys(["t", *(f"{c}_{i}" for c in ("q", "tau") for i in range(1, 3))], column)), path
    )
    return path


def parquet_of_texts(folder: Path) -> Path:
    """A dictionary of one long text, repeated."""
    path = folder / "texts.parquet"
    text = pa.DictionaryArray.from_arrays(pa.array(np.zeros(2_000_000, np.int32)), pa.array(["0" * 10_000]))
    pq.write_table(pa.table({"t": text, "q_1": text, "tau_1": text}), path)
    return path


def lerobot(folder: Path, kind: str) -> Path:
    """A data set whose rows hold far more values than joints, or whose times are long texts."""
    path = folder / f"lerobot-{kind}"
    (path / "meta").mkdir(parents=True)
    (path / "data").mkdir()
    names = {"features": {"observation.state": {"names": ["a", "b"]}}}
    (path / "meta" / "info.json").write_text(json.dumps(names))
    rows, width = 2_000, 80_000
    values = pa.array(np.zeros(rows * width, np.float32))
    lists = pa.ListArray.from_arrays(pa.array(np.arange(rows + 1, dtype=np.int32) * width), values)
    small = pa.array([[0.0, 0.0]] * rows)
    text = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), pa.array(["0" * 2_000_000]))
    table = {
        "episode_index": pa.array(np.zeros(rows, np.int64)),
        "timestamp": text if kind == "texts" else pa.array(np.arange(rows) * 0.01),
        "observation.state": lists if kind == "lists" else small,
        "action": lists if kind == "lists" else small,
    }
    pq.write_table(pa.table(table), path / "data" / "a.parquet", compression="zstd")
    return path


def packed_bag(folder: Path) -> Path:
    """A bag that its recorder has packed as a whole: a small file that fills the disk."""
    path = folder / "bag"
    path.mkdir()
    (path / "bag_0.db3.zstd").write_bytes(40 * zstandard.compress(bytes(64 << 20)))
    (path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {version: 5, storage_identifier: sqlite3, duration: {nanoseconds: 1},"
        " starting_time: {nanoseconds_since_epoch: 0}, message_count: 0, topics_with_message_count: [],"
        " compression_format: zstd, compression_mode: FILE, relative_file_paths: [bag_0.db3.zstd], files: []}\n"
    )
    return path


def blf(folder: Path) -> Path:
    """A container of a frame log that unpacks to a thousand times its size."""
    path = folder / "run.blf"
    packed = zlib.compress(bytes(GIANT >> 2), 9)
    body = struct.pack("<H6xL4x", 2, GIANT) + packed
    head = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(body), 10)
    top = struct.pack("<4sLBBBBBBBBQQLL8H8H", b"LOGG", 144, *[0] * 8, 0, 0, 0, 0, *[0] * 16).ljust(144, b"\0")
    path.write_bytes(top + head + body)
    return path


def laughs(folder: Path) -> Path:
    """An arm file whose aliases stand for 10^9 values."""
    path = folder / "laughs.yaml"
    lines = ['a0: &a0 ["x"]', *(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 10))]
    path.write_text("\n".join([*lines, "name: *a9", "kinematics: *a9"]) + "\n")
    return path


def sparse(folder: Path, name: str) -> Path:
    """A file of eight gigabytes of nothing, which has no blocks on the disk."""
    path = folder / name
    with path.open("wb") as file:
        file.truncate(8 * GIANT)
    return path


BODY = '<worldbody><body name="b"><joint name="j"/><geom size="1"/></body></worldbody>'
MODELS = {
    "entities": '<!DOCTYPE m [<!ENTITY a "'
    + "x" * 100
    + '">'
    + "".join(f'<!ENTITY {"abcdefgh"[k]} "{("&" + "abcdefgh"[k - 1] + ";") * 20}">' for k in range(1, 8))
    + f']><mujoco model="&h;">{BODY}</mujoco>',
    "heights": '<mujoco><asset><hfield name="h" nrow="40000" ncol="40000" size="1 1 1 1"/></asset>'
    '<worldbody><geom type="hfield" hfield="h"/></worldbody></mujoco>',
    "texture": '<mujoco><asset><texture name="t" type="2d" builtin="flat" width="60000" height="60000"/></asset>'
    f"{BODY}</mujoco>",
    "replicas": '<mujoco><worldbody><replicate count="10000"><replicate count="10000"><body><joint/><geom size="1"/>'
    "</body></replicate></replicate></worldbody></mujoco>",
    "keyframes": f'<mujoco><size nkey="200000000"/>{BODY}</mujoco>',
    "arena": f'<mujoco><size memory="900G"/>{BODY}</mujoco>',
    "user data": f'<mujoco><size nuserdata="2000000000"/>{BODY}</mujoco>',
    "grid": '<mujoco><worldbody><flexcomp type="grid" name="f" count="3000 3000 300" spacing="1 1 1"/></worldbody>'
    "</mujoco>",
    "includes": '<mujoco><include file="inner.xml"/></mujoco>',
}


def model(folder: Path, what: str) -> Path:
    """A model that states far more than it holds."""
    path = folder / f"{what}.xml"
    path.write_text(MODELS[what])
    (folder / "inner.xml").write_text(MODELS["keyframes"])
    return path


def sheet(folder: Path) -> Path:
    """A data sheet with an array of a billion entries."""
    path = folder / "drive.eds"
    lines = ["[2000]", "ParameterName=a", "ObjectType=0x8", "SubNumber=1", "[2000sub1]", "ParameterName=b"]
    lines += ["ObjectType=0x7", "DataType=0x7", "AccessType=rw", "[2000Name]", "NrOfEntries=1000000000"]
    path.write_text("[FileInfo]\nFileName=drive.eds\n[DeviceInfo]\n" + "\n".join(lines) + "\n")
    return path


Reader = Callable[[Path], object]


def readers() -> dict[str, Reader]:
    """Readers by the kind of file that they read."""
    from armlink.arm_file import LinkJoint, load_arm
    from armlink.bus.frame_log import LogReader
    from armlink.drives.canopen.eds_file import read_sheet
    from armlink.model_file import compile_model
    from armlink.recording.files import load_recordings

    joint = LinkJoint.model_validate({"name": "j", "node": 1, "rated_torque": 1.0, "max_torque": 1.0})

    def frames(path: Path) -> str:
        log = LogReader(path)
        list(log.frames())
        return log.warning

    return {
        "recording": load_recordings,
        "frames": frames,
        "arm": load_arm,
        "model": compile_model,
        "sheet": lambda path: read_sheet(path, joint),
    }


SPARSE = {
    "CSV": ("recording", "sparse.csv"),
    "Parquet": ("recording", "sparse.parquet"),
    "arm file": ("arm", "sparse.yaml"),
    "data sheet": ("sheet", "sparse.eds"),
    "model": ("model", "sparse.urdf"),
}
"""What is of nothing: its kind, and its name."""
BOMBS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "Parquet of one number": ("recording", parquet_of_one_number),
    "Parquet of texts": ("recording", parquet_of_texts),
    "LeRobot of texts": ("recording", partial(lerobot, kind="texts")),
    "packed bag": ("recording", packed_bag),
    "BLF": ("frames", blf),
    "line without end": ("frames", partial(sparse, name="run.log")),
    "aliases": ("arm", laughs),
    "data sheet": ("sheet", sheet),
    **{f"sparse {what}": (kind, partial(sparse, name=name)) for what, (kind, name) in SPARSE.items()},
    **{f"model, {what}": ("model", partial(model, what=what)) for what in MODELS},
}
LARGE: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "gzipped CSV": ("recording", gzipped_csv),
    "LeRobot of lists": ("recording", partial(lerobot, kind="lists")),
}
"""Bombs that take some ten seconds to make."""


def peak_memory() -> int:
    """Largest memory of this process since its start [MB]."""
    status = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) // 1000 for line in status if line.startswith("VmHWM:"))


def main(lines: list[str]) -> None:
    """Read files given as lines of JSON: name, kind, path."""
    from armlink.errors import ArmlinkError

    known = readers()
    for line in lines:
        name, kind, path = json.loads(line)
        try:
            said = f"read: {known[kind](Path(path))!r}"[:200]
        except ArmlinkError as error:
            said = f"{type(error).__name__}: {error}"
        except BaseException as error:
            said = f"escaped: {type(error).__name__}: {error}"
        sys.stdout.write(json.dumps([name, said, peak_memory()]) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.stdin.read().splitlines())
