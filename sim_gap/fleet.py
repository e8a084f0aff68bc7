"""The diagnosis of a fleet's recordings on dask.distributed: one task per case, results stored as they arrive.

A case is a folder with a model (`sim.xml`, `sim.urdf` or `sim.yaml`), `train*` and `heldout*` recordings; or, with one
model for all, each recording in the folder itself. No result is lost with a worker that dies: dask runs its cases again
elsewhere, and a stored case is not repeated.
"""

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, FiniteFloat, ValidationError

from armlink.content.atomic_file import writing
from armlink.errors import ArmlinkError, BadInput, BusFault
from armlink.recording.corrections import AS_IT_IS, Corrections
from armlink.recording.files import SUFFIXES, load_recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.model.load import parse_known_gains
from sim_gap.trends import watched_parameters


def open_to_all(scheduler: str | None) -> str:
    """A warning of a scheduler whose address is not one of TLS; empty for others."""
    if scheduler is None or scheduler.startswith("tls://"):
        return ""
    return (
        f"{scheduler}: without TLS, everybody who reaches this scheduler can run code on its workers: use tls:// "
        "and keys"
    )


@contextmanager
def cluster(scheduler: str | None, workers: int) -> Iterator[Any]:
    """A `distributed.Client` of a scheduler's address, or of `workers` processes on this machine, one thread each.

    Whoever reaches a scheduler can run code on its workers. Those made here speak TLS, with keys that are made for this
    run and that nobody else has; at an address tls:// the keys are those of dask's configuration.
    Raises BusFault (exit status 3) if no scheduler answers at the address.
    """
    from distributed import Client, LocalCluster
    from distributed.security import Security

    logging.getLogger("distributed").setLevel(logging.ERROR)
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=10.0)
        except (OSError, ValueError) as error:
            raise BusFault(
                f"there is no dask scheduler at {scheduler} ({error}): start a scheduler, or omit --scheduler"
            ) from None
        with client:
            yield client
        return
    local = LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        dashboard_address=None,
        host="tls://127.0.0.1",
        security=Security.temporary(),
        silence_logs=logging.ERROR,
    )
    with local, Client(local) as client:
        yield client


MODELS = ("sim.xml", "sim.urdf", "sim.yaml")


@dataclass(frozen=True)
class Case:
    """Files of one diagnosis; `name` is the path within the folder."""

    name: str
    sim: Path
    train: tuple[Path, ...]
    heldout: tuple[Path, ...] = ()


def find_cases(folder: Path, sim: Path | None = None) -> list[Case]:
    """All cases under a folder, by name. Raises BadInput if there is none."""
    if not folder.is_dir():
        raise BadInput(f"{folder}: there is no such folder: give a folder with cases or recordings")
    cases = [case for path in sorted(p for p in folder.rglob("*") if p.is_dir()) if (case := _case(path, folder, sim))]
    if sim is not None:
        cases += [Case(path.name, sim, (path,)) for path in _recordings(folder)]
    if not cases:
        raise BadInput(
            f"{folder} contains no case: expected folders with one of {', '.join(MODELS)}, train* and "
            "heldout* recordings, or recordings and --sim MODEL for all of them"
        )
    return cases


def _case(path: Path, folder: Path, sim: Path | None) -> Case | None:
    recordings = _recordings(path)
    train = tuple(each for each in recordings if each.name.startswith("train"))
    model = next((path / name for name in MODELS if (path / name).is_file()), sim)
    if not train or model is None:
        return None
    heldout = tuple(each for each in recordings if each.name.startswith("heldout"))
    return Case(str(path.relative_to(folder)), model, train, heldout)


def _recordings(path: Path) -> list[Path]:
    return sorted(each for each in path.iterdir() if each.is_file() and each.name.endswith(SUFFIXES))


@dataclass(frozen=True, eq=False)
class CaseOptions:
    """Statements about the arm and its recordings that all cases share, as of `armlink gap diagnose`."""

    stated: Corrections = AS_IT_IS
    gains: str = ""
    """Known gains of the position controllers (`parse_known_gains`)."""
    base: str | None = None
    tip: str | None = None

    def __post_init__(self) -> None:
        parse_known_gains(self.gains)  # what is wrong with them is no answer of a case

    def to_json(self) -> dict[str, Any]:
        """Those that differ from the default."""
        every = {**asdict(self.stated), "gains": self.gains, "base": self.base, "tip": self.tip}
        return {name: value for name, value in every.items() if value}


NO_OPTIONS = CaseOptions()


def diagnose_case(case: Case, options: CaseOptions = NO_OPTIONS) -> dict[str, Any]:
    """The JSON result of one case with what is watched, or `{"error": line}` if it cannot be diagnosed."""
    paths = [*case.train, *case.heldout]
    try:
        recordings = [load_recording(path, options.stated.of_reading()) for path in paths]
        count = len(case.train)
        answer = diagnose(
            case.sim,
            recordings[:count],
            recordings[count:],
            labels=[str(path) for path in paths],
            stated=options.stated,
            known_gains=parse_known_gains(options.gains),
            base=options.base,
            tip=options.tip,
        )
    except ArmlinkError as error:
        return {"error": str(error)}
    return answer.to_json() | {"watched": watched_parameters(answer)}


def diagnose_fleet(
    cases: list[Case], client: Any, options: CaseOptions = NO_OPTIONS
) -> Iterator[tuple[str, dict[str, Any]]]:
    """(Case name, result) as they arrive from the cluster of a `distributed.Client`; each case once."""
    from distributed import as_completed

    names = {
        client.submit(diagnose_case, case, options, key=f"gap-{case.name}", pure=False): case.name for case in cases
    }
    for future in as_completed(list(names)):
        if future.status == "finished":
            yield names[future], future.result()
        else:
            yield names[future], {"error": f"the workers failed: {future.exception()}"}
        future.release()


class _StoredParameter(BaseModel):
    value: FiniteFloat | None
    unit: str


class _StoredCause(BaseModel):
    effect: str
    parameters: dict[str, dict[str, _StoredParameter]]
    joints: list[str] = []
    shrink: float | None = None
    confidence: float | None = None
    confounded_with: list[str] = []


class _Watched(BaseModel):
    effect: str
    joint: str
    parameter: str
    value: FiniteFloat
    ci95: tuple[FiniteFloat, FiniteFloat]
    unit: str


class _StoredAnswer(BaseModel):
    verdict: str = ""
    error: str = ""
    causes: list[_StoredCause] = []
    minor: list[_StoredCause] = []
    watched: list[_Watched] = []


class _StoredLine(BaseModel):
    """The part of a case's result that table and trends read."""

    case: str
    answer: _StoredAnswer
    options: dict[str, Any] = {}


class Answers:
    """Results by case in a file of JSON lines, append-only; a line truncated by a kill is ignored.

    `found` has those that were made with the same options: others are of data that were read in another way.
    """

    def __init__(self, path: Path, options: CaseOptions = NO_OPTIONS) -> None:
        """Read the existing lines. Raises BadInput if the file has other contents or cannot be written."""
        self.path = path
        self.options = json.loads(json.dumps(options.to_json()))
        self.found: dict[str, dict[str, Any]] = {}
        other: set[str] = set()
        with writing(path), path.open("a+b") as stream:
            stream.seek(0)
            whole = stream.read()
            if whole and not whole.endswith(b"\n"):
                stream.write(b"\n")
        for number, line in enumerate(whole.splitlines(), start=1):
            try:
                _StoredLine.model_validate_json(line, strict=True)
            except ValidationError as error:
                if error.errors()[0]["type"] == "json_invalid":
                    continue
                raise BadInput(
                    f"{path}: line {number} is not a result of diagnose-fleet: give another file with --out"
                ) from None
            entry = json.loads(line)
            if entry.get("options", {}) == self.options:
                self.found[entry["case"]] = entry["answer"]
            else:
                other.add(entry["case"])
        self.of_other_options = len(other - self.found.keys())
        """Number of cases with an answer that was made with other options alone."""

    def add(self, case: str, answer: dict[str, Any]) -> None:
        """Append a result; raises BadInput if it cannot be written."""
        entry = {"case": case, "answer": answer} | ({"options": self.options} if self.options else {})
        with writing(self.path), self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(entry, ensure_ascii=False) + "\n")
        self.found[case] = answer


CAUSE_COLUMNS = ("effect", "joints", "shrink", "confidence", "confounded_with")


def table(answers: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per case and cause; a case without a cause has one row."""
    rows = []
    for case, answer in sorted(answers.items()):
        row: dict[str, Any] = {
            "arm": case.split("/")[0],
            "case": case,
            "verdict": answer.get("verdict", "failed"),
            "error": answer.get("error"),
        }
        for cause in answer.get("causes") or [{}]:
            columns = {name: cause.get(name) for name in CAUSE_COLUMNS}
            rows.append(row | {name: ", ".join(x) or None if isinstance(x, list) else x for name, x in columns.items()})
    return rows
