"""A proposal as the journal keeps it, with the newest decision on it."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from calib.daemon.view.api_models import Proposal
from calib.observer.decision import Finding


@dataclass(frozen=True)
class ProposalRow:
    """One proposed recalibration."""

    id: int
    time: datetime
    joint: str
    record: str
    """Id of the record that approval makes current."""
    base: str
    """Id of the record that it replaces."""
    values: dict[str, Any]
    """The finding, as JSON values."""
    state: str
    """pending, approved, applied, rejected, failed or superseded."""
    by: str | None
    decided: datetime | None
    note: str

    @property
    def finding(self) -> Finding:
        """The drift that it was made from."""
        return Finding.from_json(self.values)

    def answer(self) -> Proposal:
        """As the API shows it."""
        finding = self.finding
        gain_std, offset_std = finding.std
        return Proposal(
            id=self.id,
            time=self.time,
            state=self.state,  # type: ignore[arg-type]
            joint=self.joint,
            cause=finding.cause,
            gain=finding.gain,
            gain_std=gain_std,
            offset=finding.offset,
            offset_std=offset_std,
            rows=finding.rows,
            confidence=finding.confidence,
            record=self.record,
            base=self.base,
            decided_at=self.decided,
            decided_by=self.by,
            note=self.note,
        )
