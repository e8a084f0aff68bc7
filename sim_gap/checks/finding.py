"""A finding of the check of a recording, and options that correct columns."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from armlink.errors import BadInput

Kind = Literal[
    "order", "sign", "scale", "zero", "unsigned", "effort_source", "clock", "jitter", "filter", "duplicate", "dropped"
]


@dataclass(frozen=True)
class RecordingFinding:
    """One thing that is wrong with the data as they stand, and the option that corrects it."""

    finding: Kind
    channel: str
    """Column prefix of docs/formats.md, such as `tau_motor`; `t` for the time."""
    joint: str
    """Name of the joint, or `all`."""
    evidence: str
    option: str
    """Option of `armlink gap diagnose` that makes, or prevents, the correction."""
    corrected: bool
    """Whether it was corrected; where it was not, the recording is diagnosed as it stands."""

    @property
    def evidence_at(self) -> str:
        """The evidence after its channel and joint."""
        joint = "all joints" if self.joint == "all" else self.joint
        return f"{'the time t' if self.channel == 't' else f'{self.channel} of {joint}'}: {self.evidence}"

    def sentence(self) -> str:
        """For a recording that is diagnosed."""
        if not self.corrected:
            return f"{self.evidence_at} – diagnosed as recorded; to change this: {self.option}"
        other = f"option: {self.option}" if self.option.startswith("--") else f"next time, {self.option}"
        return f"{self.evidence_at} – corrected; {other}"

    def to_json(self) -> dict[str, Any]:
        return dict(vars(self))


def refuse(label: str, *found: RecordingFinding | None) -> None:
    """Raise BadInput for the first of some findings: the recording is not diagnosed until it is settled."""
    for finding in filter(None, found):
        raise BadInput(f"{label}: {finding.evidence_at} To continue: {finding.option}")


def exchange_option(channel: str, holds: Mapping[int, int]) -> str:
    """The `--map` that gives every joint its column; empty where none can, since some joint's motion is in no column.

    `holds`: column that is wrong → joint whose motion it holds, both from 0.
    """
    if set(holds) != set(holds.values()):
        return ""
    return "--map " + ",".join(f"{channel}_{joint + 1}={channel}_{column + 1}" for column, joint in holds.items())
