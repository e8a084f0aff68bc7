"""A proposal as the journal keeps it, with the newest decision on it."""

import hashlib
import json
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from calib.daemon.view.api_models import Proposal
from calib.observer.decision import DriftFinding
from calib.records.records import number_of


@dataclass(frozen=True)
class ProposalRow:
    id: int
    """Its row in this journal; a journal that is begun anew counts from 1 again, so that nobody outside knows it."""
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
    def number(self) -> int:
        """Its record's number, by which a person or a program names it: that is of what would be written and of nothing
        else, in this journal and any other."""
        return number_of(self.record)

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of what a decision on it decides: joint, records and finding."""
        content = json.dumps([self.joint, self.record, self.base, self.values], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()

    @property
    def finding(self) -> DriftFinding:
        """The drift that it was made from."""
        return DriftFinding.from_json(self.values)

    def answer(self) -> Proposal:
        finding = self.finding
        gain_std, offset_std = finding.std
        return Proposal(
            id=self.number,
            hash=self.digest,
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


PROPOSALS = (
    "SELECT p.id, p.time, p.joint, p.record, p.base, p.finding, d.state, d.by, d.time, d.note FROM proposals p "
    "LEFT JOIN decisions d ON d.id = (SELECT MAX(id) FROM decisions WHERE proposal = p.id)"
)
"""Columns that `proposal_of` takes."""


def proposal_of(row: tuple[Any, ...]) -> ProposalRow:
    """A row of PROPOSALS; raises ValueError, TypeError, KeyError or IndexError for one that holds something else."""
    number, opened, joint, record, base, finding, state, by, decided, note = row
    made = ProposalRow(
        id=number,
        time=datetime.fromisoformat(opened),
        joint=joint,
        record=record,
        base=base,
        values=json.loads(finding),
        state=state or "pending",
        by=by,
        decided=None if decided is None else datetime.fromisoformat(decided),
        note=note or "",
    )
    made.answer()
    return made
