"""Mutants of files: of their bytes, words and lines, of the trees, tables and messages that they hold."""

import copy
import gzip
import io
import json
import random
import sqlite3
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pa_parquet
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

HOSTILE = (
    *("", "-1", "0", "1e999", "-.inf", ".nan", "9" * 400, "1e308", "nan", "null", "~", "[]", "{}", "[[[[]]]]"),
    *("'../..'", "2026-11-22", "0x7fffffffffffffff", "!!python/object:os.system", "&a [*a]", "<<: *a", "\x00"),
    *("q_²", "1_000", "0o777", "-9223372036854775809", "1e-320", "é" * 200, "a: b: c", "%", "@", "`", "\t", "\u2028"),
)
VALUES: tuple[Any, ...] = (
    *(None, True, False, -1, 0, 1, 2, 65, 10**9, 2**63, -(2**63) - 1, 10**400, 0.0, 1e-320, 1e308, -1e308),
    *(float("nan"), float("inf"), "", "0", "nan", "../..", "/", "a\nb", "\ud800", "é" * 200, "x" * 70_000, "-->"),
    *([], {}, [[]], [None], {"": None}, [0.0] * 7, ["a"] * 7),
)
Mutate = Callable[[bytes, random.Random], bytes]


def mutated_text(content: bytes, draw: random.Random) -> bytes:
    """Values, words and lines of a text replaced, moved, doubled or left out."""
    lines = content.decode("utf-8", "replace").split("\n")
    for _ in range(draw.choice([1, 1, 1, 2, 5])):
        at, kind = draw.randrange(len(lines)), draw.random()
        if kind < 0.5:
            words = lines[at].replace(",", " , ").split(" ")
            words[draw.randrange(len(words))] = draw.choice(HOSTILE)
            lines[at] = " ".join(words)
        elif kind < 0.6:
            lines.insert(at, draw.choice(lines))
        elif kind < 0.7:
            del lines[at : at + draw.randrange(1, 4)]
        elif kind < 0.8:
            lines[at] = " " * draw.randrange(9) + lines[at]
        elif kind < 0.9:
            key, colon, _ = lines[at].partition(":")
            lines[at] = key + colon + " " + draw.choice(HOSTILE)
        else:
            lines[at] = lines[at] * (draw.choice([2, 50]) if len(lines[at]) < 10_000 else 1)
        lines = lines or [""]
    return "\n".join(lines).encode("utf-8", "replace")


def mutated_bytes(content: bytes, draw: random.Random) -> bytes:
    """Bits flipped, pieces cut out, doubled, moved or made random; lengths and numbers made extreme."""
    data = bytearray(content)
    for _ in range(draw.choice([1, 1, 2, 4, 16])):
        if not data:
            break
        at, kind = draw.randrange(len(data)), draw.random()
        size = draw.choice([1, 2, 4, 8, 64, 512])
        if kind < 0.35:
            data[at] ^= 1 << draw.randrange(8)
        elif kind < 0.5:
            data[at : at + size] = draw.randbytes(min(size, len(data) - at))
        elif kind < 0.65:
            data[at : at + draw.choice([1, 4, 8])] = draw.choice([b"\xff" * 8, bytes(8), b"\x7f" + b"\xff" * 7])
        elif kind < 0.75:
            del data[at : at + size]
        elif kind < 0.85:
            data[at:at] = data[draw.randrange(len(data)) :][:size]
        elif kind < 0.93:
            del data[at:]
        else:
            other = draw.randrange(len(data))
            data[at : at + size] = data[other : other + size]
    return bytes(data)


def mutated_xml(content: bytes, draw: random.Random) -> bytes:
    """Attributes of elements replaced; else as a text."""
    if draw.random() < 0.3:
        return mutated_text(content, draw)
    parts = content.decode("utf-8", "replace").split('"')
    for _ in range(draw.choice([1, 1, 2, 4])):
        if len(parts) < 3:
            break
        at = draw.randrange(len(parts) // 2) * 2 + 1
        numbers = parts[at].split(" ")
        numbers[draw.randrange(len(numbers))] = str(draw.choice((*HOSTILE, "1e30", "-0.5", "1e-30", "1 2 3 4 5 6 7")))
        parts[at] = draw.choice([" ".join(numbers), draw.choice(parts[1::2])])
    return '"'.join(parts).replace("\x00", "").encode("utf-8", "replace")


def mutated_tree(tree: Any, draw: random.Random) -> Any:
    """Nodes replaced by hostile values or by one another, left out, doubled, wrapped; the tree itself is changed."""
    for _ in range(draw.choice([1, 1, 1, 2, 4])):
        places = list(_places(tree))
        if not places:
            return draw.choice(VALUES)
        parent, key = draw.choice(places)
        kind = draw.random()
        if kind < 0.5:
            parent[key] = copy.deepcopy(draw.choice(VALUES))
        elif kind < 0.7:
            other, name = draw.choice(places)
            parent[key] = copy.deepcopy(other[name])
        elif kind < 0.8:
            del parent[key]
        elif kind < 0.9 and isinstance(parent[key], list):
            parent[key] = parent[key] * (draw.choice([2, 70]) if len(parent[key]) < 50 else 1)
        elif isinstance(parent[key], float | int):
            parent[key] *= draw.choice([-1, 0, 2, 10**9])
        else:
            parent[key] = draw.choice([[parent[key]], {str(key): parent[key]}, str(parent[key])])
    return tree


def _places(tree: Any) -> Any:
    pairs = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in pairs:
        yield tree, key
        yield from _places(value)


@lru_cache(64)
def _tree_of(content: bytes) -> Any:
    return yaml.load(content, getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def mutated_yaml(content: bytes, draw: random.Random) -> bytes:
    """A text that YAML reads: its tree, or its words and lines."""
    if draw.random() < 0.4:
        return either(content, draw)
    tree = mutated_tree(copy.deepcopy(_tree_of(content)), draw)
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    try:
        return str(yaml.dump(tree, Dumper=dumper, sort_keys=False, allow_unicode=True)).encode("utf-8", "surrogatepass")
    except (yaml.YAMLError, UnicodeError):
        return either(content, draw)


def mutated_json(content: bytes, draw: random.Random) -> bytes:
    """JSON, or lines of JSON."""
    if draw.random() < 0.2:
        return either(content, draw)
    lines = content.splitlines() if b"}\n{" in content else [content]
    at = draw.randrange(len(lines))
    tree = mutated_tree(json.loads(lines[at]), draw)
    if draw.random() < 0.02:
        return b"[" * 100_000
    lines[at] = json.dumps(tree).encode()
    return b"\n".join(lines) + b"\n"


def either(content: bytes, draw: random.Random) -> bytes:
    return (mutated_text if draw.random() < 0.7 else mutated_bytes)(content, draw)


def packed(content: bytes, draw: random.Random) -> bytes:
    """The text within, or the packed file."""
    if draw.random() < 0.5:
        return gzip.compress(either(gzip.decompress(content), draw), mtime=0)
    return mutated_bytes(content, draw)


def _column(draw: random.Random, size: int) -> pa.Array:
    """A column of some type of its own."""
    kinds: tuple[Callable[[], pa.Array], ...] = (
        lambda: pa.array([draw.choice(["1", "nan", "", "x"]) for _ in range(size)]),
        lambda: pa.array([draw.choice([None, 0.5, float("inf")]) for _ in range(size)], pa.float64()),
        lambda: pa.nulls(size),
        lambda: pa.array([draw.getrandbits(63) for _ in range(size)]),
        lambda: pa.array([[0.1] * draw.choice([0, 2, 2, 3]) for _ in range(size)], pa.list_(pa.float64())),
        lambda: pa.array([draw.choice([None, [0.1, None]]) for _ in range(size)], pa.list_(pa.float64())),
        lambda: pa.array([[["a"]]] * size),
        lambda: pa.array([{"a": 1}] * size),
        lambda: pa.array([True] * size),
        lambda: pa.array([draw.randbytes(3)] * size, pa.binary()),
        lambda: pa.array(range(size), pa.timestamp(draw.choice(["s", "ns"]))),
        lambda: pa.array(range(size), pa.duration("ns")),
        lambda: pa.array(["a"] * size).dictionary_encode(),
        lambda: pa.array(range(size)).cast(pa.decimal128(38, 3)),
        lambda: pa.array([0.1] * size, pa.float32()).cast(pa.float16()),
    )
    return draw.choice(kinds)()


@lru_cache(64)
def _table_of(content: bytes) -> pa.Table:
    return pa_parquet.ParquetFile(io.BytesIO(content)).read()


def mutated_parquet(content: bytes, draw: random.Random) -> bytes:
    """Columns of other types, names and lengths, metadata of anything; or the bytes."""
    if draw.random() < 0.4:
        return mutated_bytes(content, draw)
    table = _table_of(content)
    size = table.num_rows
    for _ in range(draw.choice([1, 1, 2])):
        at, kind = draw.randrange(table.num_columns), draw.random()
        name = draw.choice(table.column_names) if kind < 0.2 else table.column_names[at]
        if kind < 0.6:
            table = table.set_column(at, name, _column(draw, size))
        elif kind < 0.7 and table.num_columns > 1:
            table = table.remove_column(at)
        elif kind < 0.8:
            table = table.append_column(draw.choice([name, "", "q_65", "tau_é"]), _column(draw, size))
        elif kind < 0.9:
            table = table.slice(0, draw.choice([0, 1, 2]))
            size = table.num_rows
        else:
            metadata = {key: draw.randbytes(4) for key in table.schema.metadata or {b"armlink.names": b""}}
            table = table.replace_schema_metadata(metadata)
    made = io.BytesIO()
    pa_parquet.write_table(table, made)
    return made.getvalue()


def mutated_mcap(content: bytes, draw: random.Random) -> bytes:
    """Messages, topics and types changed in a file whose checksums hold; or the bytes."""
    if draw.random() < 0.3:
        return mutated_bytes(content, draw)
    made = io.BytesIO()
    packing = draw.choice([CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4])
    writer = Writer(made, compression=packing, chunk_size=2000)
    writer.start(profile="ros2")
    channels: dict[int, int] = {}
    share = draw.choice([0.0, 0.01, 0.3])
    for schema, channel, message in make_reader(io.BytesIO(content)).iter_messages():
        if channel.id not in channels:
            name, text, topic, encoding = schema.name, schema.data, channel.topic, channel.message_encoding
            kind = draw.random()
            if kind < 0.2:
                text = mutated_text(text, draw)
            elif kind < 0.3:
                name = draw.choice(
                    ["", "a", "sensor_msgs/msg/JointState", "sensor_msgs/JointState", "é/msg/é", "a/b/c/d"]
                )
            elif kind < 0.4:
                topic = draw.choice(["", "/joint_states", "/motor_states", "é", "/joint_commands"])
            elif kind < 0.45:
                encoding = draw.choice(["", "json", "cdr"])
            own = writer.register_schema(name, schema.encoding, text)
            channels[channel.id] = writer.register_channel(topic, encoding, own)
        data = either_bytes(message.data, draw) if draw.random() < share else message.data
        stamp = draw.getrandbits(64) if draw.random() < share / 10 else message.log_time
        writer.add_message(channels[channel.id], stamp, data, stamp)
    writer.finish()
    return made.getvalue()


def either_bytes(data: bytes, draw: random.Random) -> bytes:
    """Numbers and lengths of a serialised message made extreme, or its bytes changed."""
    if draw.random() < 0.5 or len(data) < 12:
        return mutated_bytes(data, draw)
    changed, at = bytearray(data), draw.randrange(4, len(data) - 7) // 4 * 4
    extreme = (
        b"\xff" * 4,
        bytes(4),
        b"\x00\x00\xf0\x7f",
        b"\x00\x00\xf8\x7f",
        b"\x01\x00\x00\x00",
        b"\x00\x00\x00\x7f",
    )
    changed[at : at + 4] = draw.choice(extreme)
    return bytes(changed)


def mutated_sqlite(content: bytes, draw: random.Random) -> bytes:
    """Cells of a database replaced, rows left out or doubled, tables dropped; or the bytes of its file."""
    if draw.random() < 0.4:
        return mutated_bytes(content, draw)
    with sqlite3.connect(":memory:") as db:
        db.deserialize(content)
        db.execute("PRAGMA foreign_keys=OFF")
        named = dict(db.execute("SELECT name, type FROM sqlite_master WHERE name NOT LIKE 'sqlite_%'"))
        for trigger in [name for name, kind in named.items() if kind == "trigger"]:
            db.execute(f'DROP TRIGGER "{trigger}"')
        tables = [name for name, kind in named.items() if kind == "table"]
        for _ in range(draw.choice([1, 1, 2])):
            table, kind = draw.choice(tables), draw.random()
            columns = [row[1] for row in db.execute(f'PRAGMA table_info("{table}")')]
            rows = [row[0] for row in db.execute(f'SELECT rowid FROM "{table}"')]
            if kind < 0.05:
                db.execute(f'ALTER TABLE "{table}" RENAME TO "aside_{draw.getrandbits(32)}"')
                tables.remove(table)
            elif columns and rows:
                _change_cell(db, table, draw.choice(columns), draw.choice(rows), draw)
            if not tables:
                break
        db.commit()
        return db.serialize()


def _change_cell(db: sqlite3.Connection, table: str, column: str, row: int, draw: random.Random) -> None:
    value = db.execute(f'SELECT "{column}" FROM "{table}" WHERE rowid=?', (row,)).fetchone()[0]
    if isinstance(value, str) and value.startswith(("{", "[")) and draw.random() < 0.7:
        new: Any = mutated_json(value.encode(), draw).decode("utf-8", "replace")
    else:
        new = draw.choice([each for each in VALUES if not isinstance(each, list | dict) and each == each] + [b"\xff"])
        new = new if not isinstance(new, int) or abs(new) < 2**63 else str(new)
        new = new if not isinstance(new, str) else new.encode("utf-8", "surrogatepass").decode("utf-8", "replace")
    try:
        db.execute(f'UPDATE "{table}" SET "{column}"=? WHERE rowid=?', (new, row))
    except sqlite3.IntegrityError:
        db.execute(f'DELETE FROM "{table}" WHERE rowid=?', (row,))


BY_SUFFIX: dict[str, Mutate] = {
    ".yaml": mutated_yaml,
    ".json": mutated_json,
    ".jsonl": mutated_json,
    ".csv": either,
    ".csv.gz": packed,
    ".asc": either,
    ".log": either,
    ".eds": either,
    ".urdf": mutated_xml,
    ".xml": mutated_xml,
    ".parquet": mutated_parquet,
    ".mcap": mutated_mcap,
    ".db": mutated_sqlite,
    ".db3": mutated_sqlite,
}
"""How files of a suffix are mutated; others by their bytes."""


def mutated(name: str, content: bytes, draw: random.Random) -> bytes:
    """A mutant of the file of this name."""
    suffix = next((each for each in sorted(BY_SUFFIX, key=len, reverse=True) if name.endswith(each)), "")
    return BY_SUFFIX.get(suffix, mutated_bytes)(content, draw)
