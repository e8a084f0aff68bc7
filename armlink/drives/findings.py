"""Results of the self-test of a drive."""

from dataclasses import dataclass
from typing import Literal

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
