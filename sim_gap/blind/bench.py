"""The blind check from end to end: cases from a separate process, sealed answers, opened labels, score.

Answers are hashed before a label is opened; labels are read only if the hashes match.
"""

import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from armlink.errors import ArmlinkError, BadInput, Refused
from sim_gap.blind.score import answer_name, score, score_positions

MANIFEST = "manifest.json"
SCHEMA = "armlink.blind-seal/1"


def write_answer(folder: Path, name: str, answer: Mapping[str, Any]) -> None:
    """Write one answer as `folder/NAME.json`. Raises Refused once the folder is sealed."""
    if (folder / MANIFEST).exists():
        raise Refused(f"{folder}: the answers are already sealed, so {name} cannot be added: use another folder")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(answer, indent=1, ensure_ascii=False), encoding="utf-8")


def seal(folder: Path) -> str:
    """Hash every answer into `folder/manifest.json` and return the manifest's own SHA-256 (hex)."""
    if (folder / MANIFEST).exists():
        raise Refused(f"{folder}: the answers are sealed already")
    hashes = _hashes(folder)
    if not hashes:
        raise BadInput(f"{folder}: there are no answers to seal")
    content = json.dumps({"schema": SCHEMA, "sha256": hashes}, indent=1, sort_keys=True)
    (folder / MANIFEST).write_text(content, encoding="utf-8")
    return hashlib.sha256(content.encode()).hexdigest()


def verify(folder: Path, digest: str | None = None) -> dict[str, dict[str, Any]]:
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


def open_labels(answers: Path, labels: Path, digest: str | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Answers and labels, both by name; the seal is checked first. Raises Refused."""
    sealed = verify(answers, digest)
    truths = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(labels.glob("*.json"))]
    return sealed, {truth["case"]: truth for truth in truths}


def _hashes(folder: Path) -> dict[str, str]:
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob("*.json"))
        if path.name != MANIFEST
    }


LENGTHS_S, SERVO_LENGTHS_S = (120.0, 40.0), (36.0, 18.0)
"""Training and held-out recordings, and those of arms with servos [s]."""
MOST_EFFECTS = 10
"""Largest number of effects in one case."""
Diagnose = Callable[[Path, Sequence[Path], Sequence[Path], Sequence[str]], dict[str, Any]]
"""Model, training and held-out recordings, effects withheld → the answer as in docs/formats.md."""


def run_bench(
    diagnose: Diagnose,
    out: Path,
    seed: int = 1,
    cases: int = 150,
    workers: int = 2,
    lengths: tuple[float, float] | None = None,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
    effects: str = "",
    positions: bool = False,
) -> dict[str, Any]:
    """Make `cases` sealed cases under `out`, have them diagnosed, seal the answers, open the labels and score.

    `lengths` are the seconds of training and held-out recordings; `effects` is the number of effects in every case such
    as `5-8`, empty for none, one or two. With `positions`, arms have servos and only `q` and `q_cmd` are seen.
    `diagnose` must be a module-level function if `workers` exceeds 1. Cases that no arm shows are left out, and counted
    in the score. Raises BadInput if `out` holds an earlier check.
    """
    _require_range(effects)
    if positions and effects:
        raise BadInput(f"--effects {effects}: cases without torque have at most one effect: leave this option out")
    if cases < 1:
        raise BadInput(f"--cases {cases}: expected at least 1")
    if any((out / name).exists() for name in ("answers", "cases", "labels")):
        raise BadInput(f"{out}: holds an earlier check: give another --out, or remove it")
    lengths = lengths or (SERVO_LENGTHS_S if positions else LENGTHS_S)
    started = time.monotonic()
    progress("making cases", 0, cases)
    given = {"seed": seed, "cases": cases, "workers": workers, "lengths": lengths}
    for done in make_apart(out, **given, effects=effects, positions=positions):
        progress("making cases", done, cases)
    made = time.monotonic()
    todo = tasks(out)
    for done, (name, answer) in enumerate(_answers(diagnose, out / "cases", todo, workers), start=1):
        write_answer(out / "answers", name, answer)
        progress("diagnosing", done, len(todo))
    digest = seal(out / "answers")
    answered = time.monotonic()
    answers, labels = open_labels(out / "answers", out / "labels", digest)
    result = score_positions(answers, labels) if positions else score(answers, labels)
    seconds = {"making": made - started, "diagnosing": answered - made}
    return {**result, "left_out": cases - len(labels), "seed": seed, "sealed": digest, "seconds": seconds}


def _require_range(effects: str) -> None:
    """Raise BadInput unless `effects` is empty or LOW-HIGH within what an arm can show."""
    if not effects:
        return
    low, _, high = effects.partition("-")
    if not (low.isdecimal() and high.isdecimal() and 1 <= int(low) <= int(high) <= MOST_EFFECTS):
        raise BadInput(f"--effects {effects}: expected LOW-HIGH from 1 to {MOST_EFFECTS}, such as 5-8")


def make_apart(out: Path, **given: Any) -> Iterator[int]:
    """Make the cases in a separate process and yield their number from time to time; `given` are arguments of
    `sim_gap.blind.cases.make_cases`. Raises Refused if it fails."""
    (out / "cases").mkdir(parents=True)
    command = [sys.executable, "-m", "sim_gap.blind.cases", json.dumps({"out": str(out), **given})]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        while True:
            try:
                _, complaint = process.communicate(timeout=2.0)
                break
            except subprocess.TimeoutExpired:
                yield len(list((out / "cases").glob("*/heldout.csv")))
    if process.returncode:
        why = complaint.strip().splitlines()[-1] if complaint else process.returncode
        raise Refused(f"the cases could not be made: {why}")


def tasks(out: Path) -> list[tuple[str, str]]:
    """(case, effect withheld or nothing) of every diagnosis to run.

    The effects to withhold are listed in `labels/withhold.txt`; no label is opened for them.
    """
    lines = (out / "labels" / "withhold.txt").read_text(encoding="utf-8").splitlines()
    withheld = [(case, effect) for case, effect in (line.split() for line in lines)]
    return [*((path.name, "") for path in sorted((out / "cases").iterdir())), *withheld]


def diagnose_files(sim: Path, train: Sequence[Path], heldout: Sequence[Path], exclude: Sequence[str]) -> dict[str, Any]:
    """The diagnosis of this package on files, with the effects `exclude` removed from its library."""
    from armlink.recording.files import load_recording
    from sim_gap.attribution.diagnose import diagnose

    parts = ([load_recording(path) for path in paths] for paths in (train, heldout))
    return diagnose(sim, *parts, withhold=exclude).to_json()


def answer_case(diagnose: Diagnose, cases: Path, case: str, withheld: str) -> tuple[str, dict[str, Any]]:
    """Name and answer of one diagnosis; refused input is an answer without causes."""
    folder, started = cases / case, time.monotonic()
    less = [withheld] if withheld else []
    try:
        answer = diagnose(folder / "sim.xml", [folder / "train.csv"], [folder / "heldout.csv"], less)
    except ArmlinkError as error:
        nothing: dict[str, Any] = {"before": [], "after": []}
        answer = {"verdict": "unexplained", "causes": [], "gap": {"heldout": nothing}, "refused": str(error)}
    except Exception as error:
        error.add_note(f"while diagnosing {folder}" + (f" without {withheld}" if withheld else ""))
        raise
    return answer_name(case, withheld), {**answer, "seconds": time.monotonic() - started}


def _answers(
    diagnose: Diagnose, cases: Path, todo: Sequence[tuple[str, str]], workers: int
) -> Iterator[tuple[str, dict[str, Any]]]:
    if workers <= 1:
        yield from (answer_case(diagnose, cases, *each) for each in todo)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(answer_case, diagnose, cases, *each) for each in todo]
        try:
            yield from (job.result() for job in as_completed(jobs))
        finally:  # after a failure, pending cases are not diagnosed
            pool.shutdown(cancel_futures=True)
