"""What the fuzzing campaigns have run, a line each, so that hours add up: python tests/campaigns/fuzz_journal.py"""

import json
import resource
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

JOURNAL = Path(__file__).with_name("fuzz_runs.jsonl")


def memory() -> float:
    """Largest resident size of this process until now [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def note(kind: str, seed: int, cpu_s: float, clock_s: float, **found: Any) -> None:
    """Append a line: what was fuzzed, how long, and what came of it; print it too."""
    line = {"day": f"{datetime.now(UTC):%Y-%m-%d}", "kind": kind, "seed": seed}
    line |= {"cpu_s": round(cpu_s), "clock_s": round(clock_s), **found}
    print(json.dumps(line), flush=True)
    with JOURNAL.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(line) + "\n")


def for_seconds(kind: str, seconds: float, seed: int, run: Callable[[int], dict[str, int]]) -> None:
    """Call `run` with one seed after the other for so much processor time; note the sums of what it counts."""
    start, began, before, counted, number = time.process_time(), time.monotonic(), memory(), Counter[str](), 0
    while time.process_time() - start < seconds:
        counted.update(run(1000 * seed + number))
        number += 1
    spent, clock = time.process_time() - start, time.monotonic() - began
    note(kind, seed, spent, clock, **counted, grown_mb=round(memory() - before))


def main() -> None:
    """The sums by kind."""
    sums: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for line in map(json.loads, JOURNAL.read_text(encoding="utf-8").splitlines()):
        for key, value in line.items():
            if key in ("slowest_s", "grown_mb"):
                sums[line["kind"]][key] = max(sums[line["kind"]][key], value)
            elif key not in ("day", "kind", "seed"):
                sums[line["kind"]][key] += value
    for kind, total in sums.items():
        print(kind, json.dumps({key: round(value, 2) for key, value in total.items()}))


if __name__ == "__main__":
    main()
