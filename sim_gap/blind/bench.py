"""The blind check from end to end: cases from other processes, sealed answers, opened labels, score.

Answers are hashed before a label is opened; labels are read only if the hashes match.
"""

import hashlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, TypeVar

from armlink.errors import ArmlinkError, BadInput, Refused
from armlink.recording.files import load_recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.blind.cases import make_case, write_withheld
from sim_gap.blind.recipe import recipes, servo_recipes
from sim_gap.blind.score import answer_name, score, score_positions

MANIFEST = "manifest.json"
SCHEMA = "armlink.blind-seal/1"
LENGTHS_S, SERVO_LENGTHS_S = (120.0, 40.0), (36.0, 18.0)
"""Training and held-out recordings, and those of arms with servos [s]."""
MOST_EFFECTS = 10
"""Largest number of effects in one case."""
Made = TypeVar("Made")
Json = dict[str, Any]
Diagnose = Callable[[Path, Sequence[str]], Json]
"""Folder of a case, effects withheld → the answer as in docs/formats.md."""
Progress = Callable[[str, int, int], None]
"""Stage, number of those that are done, number of all."""


def run_bench(
    diagnose: Diagnose,
    out: Path,
    seed: int = 1,
    cases: int = 150,
    workers: int = 2,
    lengths: tuple[float, float] | None = None,
    progress: Progress = lambda *_: None,
    effects: str = "",
    positions: bool = False,
) -> Json:
    """Make `cases` sealed cases under `out`, have them diagnosed, seal the answers, open the labels and score.

    `lengths` are the seconds of training and held-out recordings; `effects` is the number of effects in every case such
    as `5-8`, empty for none, one or two. With `positions`, arms have servos and only `q` and `q_cmd` are seen.
    `diagnose` must be a module-level function if `workers` exceeds 1. Cases that no arm shows are left out, and counted
    in the score. Raises BadInput if `out` holds an earlier check.
    """
    if cases < 1:
        raise BadInput(f"--cases {cases}: expected at least 1")
    started = time.monotonic()
    for done in make_cases(out, seed, cases, workers, lengths, effects, positions):
        progress("making cases", done, cases)
    made = time.monotonic()
    jobs = {answer_name(case, *less): partial(diagnose, out / "cases" / case, less) for case, *less in tasks(out)}
    digest = seal_answers(out / "answers", jobs, workers, progress)
    answered = time.monotonic()
    answers, labels = open_labels(out / "answers", out / "labels", digest)
    result = score_positions(answers, labels) if positions else score(answers, labels)
    seconds = {"making": made - started, "diagnosing": answered - made}
    return {**result, "left_out": cases - len(labels), "seed": seed, "sealed": digest, "seconds": seconds}


def refuse_earlier(out: Path) -> None:
    """Raise BadInput if a folder holds an earlier check."""
    if any((out / name).exists() for name in ("answers", "cases", "labels")):
        raise BadInput(f"{out} holds an earlier check: give another folder with --out, or remove this folder")


def make_cases(
    out: Path,
    seed: int,
    cases: int,
    workers: int,
    lengths: tuple[float, float] | None = None,
    effects: str = "",
    positions: bool = False,
) -> Iterator[int]:
    """Make the cases of `run_bench` and yield their number; what knows a label runs in other processes."""
    low, _, high = effects.partition("-")
    if effects and not (low.isdecimal() and high.isdecimal() and 1 <= int(low) <= int(high) <= MOST_EFFECTS):
        raise BadInput(f"--effects {effects}: expected LOW-HIGH from 1 to {MOST_EFFECTS}, such as 5-8")
    if positions and effects:
        raise BadInput(f"--effects {effects}: cases without torque have at most one effect: leave this option out")
    refuse_earlier(out)
    labels, seconds = out / "labels", lengths or (SERVO_LENGTHS_S if positions else LENGTHS_S)
    for folder in (out / "cases", labels):
        folder.mkdir(parents=True)
    several = (int(low), int(high)) if effects else None
    wanted = servo_recipes(seed, cases) if positions else recipes(seed, cases, several)
    jobs = [partial(make_case, recipe, out / "cases", labels, *seconds) for recipe in wanted]
    yield 0
    for done, _ in enumerate(_run_apart(jobs, workers), start=1):
        yield done
    list(_run_apart([partial(write_withheld, labels, positions)], 1))


def tasks(out: Path) -> list[list[str]]:
    """Case, and effect withheld if there is one, of every diagnosis to run.

    The effects to withhold are listed in `labels/withhold.txt`; no label is opened for them.
    """
    withheld = (out / "labels" / "withhold.txt").read_text(encoding="utf-8").splitlines()
    return [*([path.name] for path in sorted((out / "cases").iterdir())), *(line.split() for line in withheld)]


def diagnose_folder(folder: Path, withheld: Sequence[str]) -> Json:
    """The diagnosis of this package on the files of a case, with these effects removed from its library."""
    train, heldout = ([load_recording(folder / f"{name}.csv")] for name in ("train", "heldout"))
    return diagnose(folder / "sim.xml", train, heldout, withhold=withheld).to_json()


def seal_answers(
    folder: Path, jobs: Mapping[str, Callable[[], Json]], workers: int, progress: Progress = lambda *_: None
) -> str:
    """Write the answer of each job as `folder/NAME.json` as it comes, then seal all; SHA-256 of the seal."""
    folder.mkdir(parents=True)
    todo = [partial(_answer, name, job) for name, job in jobs.items()]
    found = _run_apart(todo, workers) if workers > 1 else (job() for job in todo)
    for done, (name, answer) in enumerate(found, start=1):
        (folder / f"{name}.json").write_text(json.dumps(answer, indent=1, ensure_ascii=False), encoding="utf-8")
        progress("diagnosing", done, len(jobs))
    return seal(folder)


def _answer(name: str, job: Callable[[], Json]) -> tuple[str, Json]:
    """Name and answer of one diagnosis; refused input is an answer without causes."""
    started = time.monotonic()
    try:
        answer = job()
    except ArmlinkError as error:
        nothing: Json = {"before": [], "after": []}
        answer = {"verdict": "unexplained", "causes": [], "gap": {"heldout": nothing}, "refused": str(error)}
    except Exception as error:
        error.add_note(f"while diagnosing {name}")
        raise
    return name, {**answer, "seconds": time.monotonic() - started}


def _run_apart(jobs: Sequence[Callable[[], Made]], workers: int) -> Iterator[Made]:
    """Results in the order in which they come from `workers` processes."""
    with ProcessPoolExecutor(workers, get_context("spawn"), _end_with_parent) as pool:
        futures = [pool.submit(job) for job in jobs]
        try:
            yield from (future.result() for future in as_completed(futures))
        finally:  # after a failure, pending jobs are not begun
            pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """A worker ends when the process that began it is killed."""

    def watch() -> None:
        if (parent := parent_process()) is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# ---- the seal


def seal(folder: Path) -> str:
    """Hash every answer into `folder/manifest.json` and return the manifest's own SHA-256 (hex)."""
    hashes = _hashes(folder)
    if not hashes:
        raise BadInput(f"{folder}: there are no answers to seal")
    content = json.dumps({"schema": SCHEMA, "sha256": hashes}, indent=1, sort_keys=True)
    (folder / MANIFEST).write_text(content, encoding="utf-8")
    return hashlib.sha256(content.encode()).hexdigest()


def verify(folder: Path, digest: str | None = None) -> dict[str, Json]:
    """The sealed answers by name.

    Raises Refused if an answer was changed, added or removed, or the manifest's own SHA-256 is not `digest`.
    """
    manifest = folder / MANIFEST
    if not manifest.is_file():
        raise Refused(f"{folder}: the answers are not sealed: seal them before you open the labels")
    content = manifest.read_bytes()
    if digest is not None and hashlib.sha256(content).hexdigest() != digest:
        raise Refused(f"{manifest}: this is not the manifest that was sealed")
    sealed, now = json.loads(content)["sha256"], _hashes(folder)
    for name in sorted(set(sealed) | set(now)):
        if sealed.get(name) != now.get(name):
            what = "was removed" if name not in now else "was added" if name not in sealed else "was changed"
            raise Refused(f"{folder / name}: {what} after sealing")
    return {name.removesuffix(".json"): json.loads((folder / name).read_text(encoding="utf-8")) for name in sealed}


def open_labels(answers: Path, labels: Path, digest: str | None = None) -> tuple[dict[str, Json], dict[str, Json]]:
    """Answers and labels, both by name; the seal is checked first. Raises Refused."""
    sealed = verify(answers, digest)
    truths = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(labels.glob("*.json"))]
    return sealed, {truth["case"]: truth for truth in truths}


def _hashes(folder: Path) -> dict[str, str]:
    paths = (path for path in sorted(folder.glob("*.json")) if path.name != MANIFEST)
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
