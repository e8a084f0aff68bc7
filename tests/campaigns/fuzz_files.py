"""Campaign: mutated arm files, records and recordings of every format. Each loads, or is refused in one line.

python tests/campaigns/fuzz_files.py [--seconds 3600] [--kinds arm record csv gz parquet mcap] [--seed 0] [--keep DIR]

Of each kind for so many seconds of processor time: bytes flipped, cut out, doubled and spliced, numbers made extreme,
keys and lines moved, of whole files too. Exit status 1 for an exception other than ArmlinkError, a message of several
lines, more than 5 s for a file, or memory that grows by more than 500 MB; what did it is kept in DIR.
"""

import argparse
import gzip
import json
import logging
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "calib"))

from made_records import arm_file, calibration, gravity

from armlink.arm_file import bundled_arms, load_arm
from armlink.errors import ArmlinkError
from armlink.recording.files import load_recording, save_recording
from armlink.recording.recording import Recording
from calib.arm.sweep_section import sweep_section
from calib.records.store import RecordStore

LONGEST = 5.0
GROWTH = 500_000_000
HOSTILE = (
    *("", "-1", "0", "1e999", "-.inf", ".nan", "9" * 400, "1e308", "nan", "null", "~", "[]", "{}", "[[[[]]]]"),
    *(
        "'../..'",
        "2026-11-22",
        "0x7fffffffffffffff",
        "!!python/object:os.system",
        "&a [*a]",
        "<<: *a",
        "\x00",
        "\u2028",
    ),
    *("q_²", "1_000", "0o777", "-9223372036854775809", "1e-320", "é" * 200, "a: b: c", "%", "@", "`", "\t", "\u2028"),
)


class TooSlow(Exception):
    """A file took longer than it may."""


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
            lines[at] = lines[at] * draw.choice([2, 50])
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


def either(content: bytes, draw: random.Random) -> bytes:
    return (mutated_text if draw.random() < 0.7 else mutated_bytes)(content, draw)


def packed(content: bytes, draw: random.Random) -> bytes:
    """The text within, or the packed file."""
    if draw.random() < 0.5:
        return gzip.compress(either(gzip.decompress(content), draw), mtime=0)
    return mutated_bytes(content, draw)


def load_whole_arm(path: Path) -> None:
    """As commands do: the file, and the sections that they use."""
    arm = load_arm(path)
    arm.require_link()
    sweep_section(arm)


def seeds(folder: Path) -> dict[str, list[tuple[str, bytes]]]:
    """Kind → files to begin with, by suffix."""
    t = np.arange(120) * 0.01
    wave = np.sin(t)[:, None] * np.ones(2)
    recording = Recording(t=t, position=wave, torque=2 * wave, names=("a", "b"))
    found: dict[str, list[tuple[str, bytes]]] = {
        "arm": [(".yaml", path.read_bytes()) for path in bundled_arms().values()],
        "record": [(".yaml", each.model_dump_json(indent=1).encode()) for each in (calibration(), gravity())],
    }
    for kind, suffix in {"csv": ".csv", "gz": ".csv.gz", "parquet": ".parquet", "mcap": ".mcap"}.items():
        save_recording(recording, folder / f"seed{suffix}")
        found[kind] = [(suffix, (folder / f"seed{suffix}").read_bytes())]
    return found


def import_record(path: Path) -> None:
    """As `armlink history --import` does."""
    store = RecordStore(str(path.parent / "records.db"))
    try:
        store.import_yaml(path, arm_file())
    finally:
        store.close()


LOAD: dict[str, Callable[[Path], object]] = {"arm": load_whole_arm, "record": import_record}
MUTATE: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "arm": either,
    "record": either,
    "csv": either,
    "gz": packed,
}


def fuzz(kind: str, files: list[tuple[str, bytes]], seconds: float, seed: int, folder: Path, keep: Path) -> list[str]:
    """Mutants of one kind for so long; what was wrong, each once."""
    draw, tried, wrong = random.Random(f"{kind} {seed}"), Counter[str](), dict[str, str]()
    load, mutate = LOAD.get(kind, load_recording), MUTATE.get(kind, mutated_bytes)
    end, slowest, before = time.process_time() + seconds, 0.0, memory()
    while time.process_time() < end:
        suffix, content = draw.choice(files)
        mutant = mutate(content, draw)
        path = folder / f"mutant{suffix}"
        path.write_bytes(mutant)
        began, what = time.process_time(), ""
        signal.setitimer(signal.ITIMER_PROF, LONGEST)
        try:
            load(path)
            tried["loaded"] += 1
        except ArmlinkError as error:
            tried["refused"] += 1
            what = "a message of several lines" if "\n" in str(error) else ""
        except (Exception, RecursionError) as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            what = f"{type(error).__name__} at {Path(place.filename).name}:{place.lineno}: {str(error)[:200]}"
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        slowest = max(slowest, time.process_time() - began)
        if what and what.partition(": ")[0] not in wrong:
            name = f"{kind}-{zlib.crc32(mutant):08x}{suffix}"
            wrong[what.partition(": ")[0]] = f"{kind}: {what} ({name})"
            (keep / name).write_bytes(mutant)
    grown = memory() - before
    if grown > GROWTH:
        wrong["memory"] = f"{kind}: memory grew by {grown / 1e6:.0f} MB"
    print(
        json.dumps({"kind": kind, **tried, "slowest_s": round(slowest, 2), "grown_mb": round(grown / 1e6)}), flush=True
    )
    return list(wrong.values())


def memory() -> float:
    """Largest resident size until now [bytes]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0


def too_slow(*_: object) -> None:
    raise TooSlow(f"more than {LONGEST:g} s")


def main() -> int:
    """Fuzz one kind after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--kinds", nargs="+", default=["arm", "record", "csv", "gz", "parquet", "mcap"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("fuzz-corpus"))
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    signal.signal(signal.SIGPROF, too_slow)
    given.keep.mkdir(parents=True, exist_ok=True)
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        for kind, files in seeds(Path(name)).items():
            if kind in given.kinds:
                wrong += fuzz(kind, files, given.seconds, given.seed, Path(name), given.keep)
    for line in wrong:
        print(f"FAILED: {line}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
