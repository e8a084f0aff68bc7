"""Findings about an arm's set-up: what is missing or doubtful."""

from dataclasses import dataclass
from typing import Any, Literal

Level = Literal["error", "warning", "hint"]
ORDER: dict[Level, int] = {"error": 0, "warning": 1, "hint": 2}


@dataclass(frozen=True)
class SetupFinding:
    """One finding: what is wrong, where, and how to put it right."""

    level: Level
    what: str
    where: str
    remedy: str

    def to_json(self) -> dict[str, Any]:
        return {"level": self.level, "what": self.what, "where": self.where, "remedy": self.remedy}

    def __str__(self) -> str:
        return f"{self.where}: {self.what}: {self.remedy}"
