"""Drives on a bus that no arm file describes yet; findings about drives, and results of their self-test."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol


@dataclass(frozen=True)
class FoundDrive:
    """One drive as it answers."""

    node: int
    """Its id on the bus."""
    vendor: int
    product: int
    rated_torque: float
    """[N·m]"""
    max_torque: float
    """Most that it is set to [N·m]."""
    unit: float
    """One count of its position [rad]."""
    drive: Mapping[str, Any] | None = None
    """`link.joints[].drive` of an arm file, where its node id alone does not say what it is."""

    @property
    def keys(self) -> dict[str, Any]:
        """As a row of `link.joints` names it."""
        return {"node": self.node} if self.drive is None else {"drive": dict(self.drive)}


class FoundDrives(Protocol):
    """The drives of an open bus."""

    @property
    def found(self) -> list[FoundDrive]: ...

    def positions(self) -> dict[int, float]:
        """Position reading of every drive by its id [rad]; raises BusFault."""
        ...


Level = Literal["error", "warning", "hint"]


@dataclass(frozen=True)
class SetupFinding:
    """A lack or doubt about a drive or an arm's set-up, its place, and its remedy."""

    level: Level
    what: str
    where: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}: {self.remedy}"


Outcome = Literal["passed", "failed", "absent", "not run"]


@dataclass(frozen=True)
class Result:
    """One check of one joint."""

    joint: str
    check: str
    """`GROUP` or `GROUP: PART`."""
    outcome: Outcome
    found: str
    seconds: float | None = None
    """How long the device took, where that was measured [s]."""
