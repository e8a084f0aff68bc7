"""Distil the corpus of the tests: of many mutants those that reach lines, or get answers, that none before did.

    python tests/campaigns/fuzz_corpus.py [--kinds arm csv … six-damiao api] [--tries 2000] [--seed 0]

It goes to tests/faults/corpus: a folder of each kind of file with a folder an input, `api` with a file a connection,
and `frames-of-drives` with a line a frame of each family. Inputs that failed once have names there, and are kept.
"""

import argparse
import logging
import random
import re
import sys
import tempfile
import warnings
import zlib
from collections.abc import Callable, Hashable, Iterable
from pathlib import Path
from typing import Any, TypeVar

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[1] / "armlink" / "drives"))
sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from bench import Bench
from fuzz_api import begin, exchange, hostile, statuses
from fuzz_files import fresh, mutant_of
from fuzz_kinds import KINDS, ROOT, Seed
from fuzzing import FAMILIES, known_frames, spoilt, take_in
from served_page import served

from calib.daemon.rate_limit import RateLimit
from calib.daemon.web import connection

CORPUS = Path(__file__).parents[1] / "faults" / "corpus"
LARGEST = 20_000
"""Of an input in the corpus [bytes]."""
OURS = tuple(str(ROOT / package) for package in ("armlink", "calib", "gcomp", "sim_bus", "sim_gap"))
Input = TypeVar("Input")


def lines_of(run: Callable[[], Any]) -> set[Hashable]:
    """Lines of our packages that it runs through, whatever it raises."""
    seen: set[Hashable] = set()

    def line(frame: Any, event: str, _: Any) -> Any:
        seen.add((frame.f_code.co_filename, frame.f_lineno))
        return line

    def call(frame: Any, event: str, _: Any) -> Any:
        return line if frame.f_code.co_filename.startswith(OURS) else None

    sys.settrace(call)
    try:
        run()
    except Exception:
        pass
    finally:
        sys.settrace(None)
    return seen


def distil(
    inputs: Iterable[Input], reaches: Callable[[Input], set[Hashable]], size: Callable[[Input], int]
) -> list[Input]:
    """The inputs that together reach what all reach: those that reach most first, the smaller of equals."""
    found = [(reaches(each), each) for each in inputs if size(each) <= LARGEST]
    kept, left = [], set[Hashable]().union(*(reached for reached, _ in found))
    while left:
        reached, best = max(found, key=lambda pair: (len(pair[0] & left), -size(pair[1])))
        kept.append(best)
        left -= reached
    return kept


def files(kind: str, tries: int, draw: random.Random) -> None:
    """Mutants of a kind of file, each in a folder that is named by its content."""
    with tempfile.TemporaryDirectory() as folder:
        (seeds := Path(folder) / "seeds").mkdir()
        sound = KINDS[kind].seeds(seeds)

        def reaches(mutant: Seed) -> set[Hashable]:
            path = mutant.put(fresh(Path(folder) / "mutant"))
            return lines_of(lambda: KINDS[kind].load(path))

        mutants = [mutant_of(sound, draw) for _ in range(tries)]
        for mutant in distil(mutants, reaches, lambda mutant: sum(map(len, mutant.files.values()))):
            mutant.put(fresh(CORPUS / kind / f"{zlib.crc32(repr(mutant).encode()):08x}"))


def frames(family: str, tries: int, draw: random.Random) -> None:
    """Frames that reach new lines of a family's drives, in their order."""
    bench, rng, seen, kept = Bench(family), np.random.default_rng(draw.getrandbits(32)), set[Hashable](), []
    bench.set_up()
    bench.walk()
    for number in range(tries):
        if number % 50 == 0:
            known = known_frames(bench)
        can_id, data = spoilt(rng, known, 64 if bench.link.bus.fd else 8)
        reached = lines_of(lambda can_id=can_id, data=data: take_in(bench, can_id, data))
        if reached - seen:
            kept.append(f"{can_id:08X}#{data.hex().upper()}")
            seen |= reached
    (CORPUS / "frames-of-drives" / f"{family}.log").write_text("\n".join(kept) + "\n")


def answers(sent: bytes, answer: bytes) -> set[Hashable]:
    """Statuses in their order, and what is said, without numbers."""
    said = re.findall(rb'"(?:detail|msg|type)": ?"([^"]*)"', answer)
    return {tuple(statuses(sent, answer, False))[:3], *(re.sub(rb"\d+", b"", each)[:80] for each in said)}


def connections(tries: int, draw: random.Random) -> None:
    """What connections send that get answers of a new kind."""
    RateLimit.take = lambda *_: 0.0  # type: ignore[method-assign, assignment]
    connection.PATIENCE_SECONDS = 0.5
    with tempfile.TemporaryDirectory() as name, served(lambda: begin(Path(name)), Path(name) / "api.sock") as server:
        sent = [hostile(draw) for _ in range(tries)]
        kept = distil(sent, lambda each: answers(each, exchange(server, each, False, draw)), len)
    for each in kept:
        (CORPUS / "api" / f"{zlib.crc32(each):08x}.http").write_bytes(each)


def main() -> int:
    """Distil the kinds one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    every = [*KINDS, *FAMILIES, "api"]
    parser.add_argument("--kinds", nargs="+", default=every, choices=every)
    parser.add_argument("--tries", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    for folder in ("api", "frames-of-drives"):
        (CORPUS / folder).mkdir(parents=True, exist_ok=True)
    for kind in given.kinds:
        draw = random.Random(f"{kind} {given.seed}")
        if kind in KINDS:
            files(kind, given.tries, draw)
        elif kind in FAMILIES:
            frames(kind, given.tries, draw)
        else:
            connections(given.tries, draw)
        print(kind, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
