"""Campaign: mutated arm files, records, recordings, models and more. Each loads, or is refused in one line.

python tests/campaigns/fuzz_files.py [--seconds 3600] [--round 300] [--kinds arm record …] [--seed 0] [--keep DIR]

Of each kind for so many seconds of processor time, in rounds and a process of its own each: bytes, words, lines, trees,
tables and messages changed (`fuzz_mutators`). Exit status 1 for an exception other than ArmlinkError, a message of
several lines, more than 5 s for a file, memory that grows by more than 500 MB, or a process that dies; what did it is
kept in DIR. What was run is noted in `fuzz_runs.jsonl`.
"""

import argparse
import json
import logging
import multiprocessing
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[2]))

from fuzz_journal import memory, note
from fuzz_kinds import KINDS, Kind, Seed
from fuzz_mutators import mutated

from armlink.errors import ArmlinkError

LONGEST, GROWTH, ADDRESSES = 5.0, 500.0, 8_000_000_000
"""Of a file [s]; of a round's memory [MB]; of its process [bytes]."""


class TooSlow(BaseException):
    """A file took longer than it may; no Exception, so that nothing takes it for a damaged file."""


def mutant_of(seeds: list[Seed], draw: random.Random) -> Seed:
    """One of the files of one seed mutated."""
    seed = draw.choice(seeds)
    name = draw.choice(sorted(seed.files))
    return Seed({**seed.files, name: mutated(name, seed.files[name], draw)}, seed.given)


def judged(kind: Kind, path: Path, tried: Counter[str] | None = None) -> str:
    """What is wrong with how this input is taken; empty if nothing."""
    tried = Counter() if tried is None else tried
    signal.setitimer(signal.ITIMER_PROF, LONGEST)
    try:
        kind.load(path)
        tried["loaded"] += 1
    except (ArmlinkError, *kind.refusals) as error:
        tried["refused"] += 1
        return f"a message of several lines: {error}" if "\n" in str(error) else ""
    except (Exception, TooSlow) as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__} at {Path(place.filename).name}:{place.lineno}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return ""


def keep(mutant: Seed, name: str, folder: Path) -> None:
    """The input in a folder of its own."""
    shutil.rmtree(folder / name, ignore_errors=True)
    (folder / name).mkdir(parents=True)
    mutant.put(folder / name)


def fuzz(name: str, seconds: float, seed: str, kept: Path) -> None:
    """One round, in a process of its own: mutants of a kind for so long; what came of it goes to `kept/round.json`."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGPROF, too_slow)
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, ADDRESSES))
    kind, draw = KINDS[name], random.Random(f"{name} {seed}")
    tried, wrong, slowest = Counter[str](), dict[str, str](), 0.0
    with tempfile.TemporaryDirectory() as folder:
        (begin := Path(folder) / "seeds").mkdir()
        seeds = kind.seeds(begin)
        for each in seeds:
            kind.load(each.put(fresh(Path(folder) / "sound")))
        before, started = memory(), time.process_time()
        while time.process_time() - started < seconds:
            mutant = mutant_of(seeds, draw)
            path = mutant.put(fresh(Path(folder) / "mutant"))
            keep(mutant, f"{name}-last", kept) if name in NATIVE else None
            began = time.process_time()
            what = judged(kind, path, tried)
            slowest = max(slowest, time.process_time() - began)
            if what and (place := what.partition(": ")[0]) not in wrong:
                label = f"{name}-{zlib.crc32(repr(mutant).encode()):08x}"
                wrong[place] = f"{name}: {what} ({label})"
                keep(mutant, label, kept)
    spent, grown = time.process_time() - started, memory() - before
    if grown > GROWTH:
        wrong["memory"] = f"{name}: memory grew by {grown:.0f} MB"
    found = {"cpu_s": spent, **tried, "slowest_s": round(slowest, 2), "grown_mb": round(grown)}
    (kept / f"{name}-round.json").write_text(json.dumps({"found": found, "wrong": list(wrong.values())}))


NATIVE = ("model",)
"""Kinds read by code that could end the process: their last mutant is kept beforehand."""


def fresh(folder: Path) -> Path:
    """An empty folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def too_slow(*_: object) -> None:
    raise TooSlow(f"more than {LONGEST:g} s")


def one_round(name: str, seconds: float, seed: int, number: int, kept: Path) -> list[str]:
    """Run a round and note it; what was wrong."""
    said = kept / f"{name}-round.json"
    said.unlink(missing_ok=True)
    began = time.monotonic()
    round_of = multiprocessing.get_context("fork").Process(target=fuzz, args=(name, seconds, f"{seed} {number}", kept))
    round_of.start()
    round_of.join()
    if not said.exists():
        return [f"{name}: the process ended with {round_of.exitcode}: {name}-last"]
    told = json.loads(said.read_text())
    said.unlink()
    note(name, seed, told["found"].pop("cpu_s"), time.monotonic() - began, **told["found"], wrong=len(told["wrong"]))
    return list(told["wrong"])


def main() -> int:
    """Fuzz the kinds by turns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--round", type=float, default=300.0)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("fuzz-corpus"))
    given = parser.parse_args()
    given.keep.mkdir(parents=True, exist_ok=True)
    wrong = dict[str, str]()
    for number in range(max(1, round(given.seconds / given.round))):
        for name in given.kinds:
            for line in one_round(name, min(given.round, given.seconds), given.seed, number, given.keep):
                if wrong.setdefault(line.partition(": ")[2].partition(": ")[0], line) == line:
                    print(f"FAILED: {line}", flush=True)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
