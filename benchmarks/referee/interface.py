"""What a tool gets and what it may answer; it needs NumPy alone, so an adapter's interpreter may be one of its own.

A case is a folder: `sim.xml` (the nominal model), `train_1.csv` and so on, and `case.json`. An adapter is a file with
`solve(case: Case) -> Answer`. It may leave out of the answer whatever its tool does not offer: None is "not offered",
an empty list "nothing found".
"""

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

SCHEMA = "armlink.referee-answer/1"
CHANNELS = ("q", "dq", "tau", "tau_motor", "tau_cmd", "q_cmd")


TABLES = json.loads(Path(__file__).with_name("families.json").read_text(encoding="utf-8"))
FAMILY = {effect: family for family, effects in TABLES["families"].items() for effect in effects}


def target(name: str, vocabulary: str) -> str:
    """`effect:quantity` of a tool's word; words that no table has are their own."""
    return str(TABLES["vocabularies"].get(vocabulary, {}).get(name, name))


def family(name: str, vocabulary: str) -> str:
    effect = target(name, vocabulary).partition(":")[0]
    return str(FAMILY.get(effect, effect))


class NotOffered(Exception):
    """Raised by an adapter whose tool is not made for this kind of case."""


@dataclass(frozen=True)
class Recorded:
    """One recording: `t` (K,) [s]; channels (K, n) in SI units, with those that were recorded."""

    path: Path
    t: Any
    channels: dict[str, Any]

    def __getitem__(self, name: str) -> Any:
        return self.channels[name]

    @property
    def torque(self) -> Any:
        """The motors' torque where it was recorded, else that of the torque sensors [N·m] (K, n)."""
        return self.channels.get("tau_motor", self.channels.get("tau"))


@dataclass(frozen=True)
class Case:
    """The public part of a case."""

    folder: Path
    joints: tuple[str, ...]
    """Names of the joints in `sim.xml`, in the order of the columns."""
    kind: str
    """`torque` (at the joint and of the motor), `motor_torque`, or `positions` (and their commands)."""
    withheld: tuple[str, ...] = ()
    """Effects, by their ids in `families.json`, that the tool has to leave out of its library."""
    cpu_seconds: float = 120.0
    """Processor time that the tool may take; the process is ended then."""

    @property
    def model(self) -> Path:
        return self.folder / "sim.xml"

    @property
    def train(self) -> list[Recorded]:
        return [read_recording(path, len(self.joints)) for path in sorted(self.folder.glob("train_*.csv*"))]


@dataclass(frozen=True)
class Cause:
    """An effect that the tool names, in its own words (see `families.json`)."""

    name: str
    joints: tuple[str, ...]
    confidence: float
    """From 0 to 1; above 0.8 it is meant to be sure."""


@dataclass(frozen=True)
class Parameter:
    """A value of the real arm with its 95 % interval, in the tool's own words: the whole value, not a difference."""

    name: str
    joint: str
    """Empty for one of the whole arm."""
    value: float
    low: float | None = None
    high: float | None = None
    nominal: float | None = None
    """The same quantity in `sim.xml`."""


@dataclass(frozen=True)
class Answer:
    vocabulary: str
    """Whose words `name` is in: a key of `families.json`."""
    causes: list[Cause] | None = None
    """The most important first."""
    parameters: list[Parameter] | None = None
    model: str | None = None
    """MJCF text of the corrected model, complete by itself: same joint names, same actuators."""
    note: str = ""
    extra: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return {"schema": SCHEMA, **asdict(self)}


def check(answer: Answer, case: Case) -> None:
    """Raise ValueError with what an answer must not have: a number that is none, an interval or confidence that cannot
    be, a joint that the model lacks, a vocabulary or cause that `families.json` does not have."""
    words = TABLES["vocabularies"]
    if answer.vocabulary not in words:
        raise ValueError(f"vocabulary {answer.vocabulary!r} is not in families.json, which has {', '.join(words)}")
    for cause in answer.causes or ():
        if target(cause.name, answer.vocabulary).partition(":")[0] not in FAMILY:
            raise ValueError(f"cause {cause.name!r}: the vocabulary {answer.vocabulary!r} of families.json lacks it")
        if not 0.0 <= cause.confidence <= 1.0:
            raise ValueError(f"cause {cause.name!r}: confidence {cause.confidence} instead of 0 to 1")
        if unknown := [joint for joint in cause.joints if joint not in case.joints]:
            raise ValueError(f"cause {cause.name!r}: the model has no joint {unknown[0]!r}")
    for p in answer.parameters or ():
        what = f"parameter {p.name!r} of joint {p.joint!r}" if p.joint else f"parameter {p.name!r}"
        if p.joint and p.joint not in case.joints:
            raise ValueError(f"{what}: the model has no such joint")
        if not all(math.isfinite(x) for x in (p.value, p.nominal) if x is not None):
            raise ValueError(f"{what}: its value {p.value} or its nominal value {p.nominal} is not a finite number")
        if (p.low is None) != (p.high is None) or (p.low is not None and not p.low <= p.value <= p.high):
            raise ValueError(f"{what}: {p.value} is not between {p.low} and {p.high}")


def answer_from_json(made: dict[str, Any]) -> Answer:
    causes, parameters = made.get("causes"), made.get("parameters")
    return Answer(
        made["vocabulary"],
        None if causes is None else [Cause(c["name"], tuple(c["joints"]), float(c["confidence"])) for c in causes],
        None if parameters is None else [Parameter(**p) for p in parameters],
        made.get("model"),
        made.get("note", ""),
        made.get("extra", {}),
    )


def load_case(folder: Path) -> Case:
    told = json.loads((folder / "case.json").read_text(encoding="utf-8"))
    joints, withheld = tuple(told["joints"]), tuple(told["withheld"])
    return Case(folder, joints, told["kind"], withheld, float(told["cpu_seconds"]))


def read_recording(path: Path, n: int) -> Recorded:
    """Columns `t`, `q_1` … `q_n` and those of the other channels (docs/formats.md, tables)."""
    table = np.genfromtxt(path, delimiter=",", names=True)
    names = set(table.dtype.names or ())
    channels = {
        channel: np.column_stack([table[f"{channel}_{j + 1}"] for j in range(n)])
        for channel in CHANNELS
        if f"{channel}_1" in names
    }
    return Recorded(path, np.asarray(table["t"]), channels)
