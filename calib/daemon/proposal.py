"""A proposal and its finding, as the journal keeps them and as the API shows them."""

from typing import Any

import numpy as np

from calib.daemon.state.journal import ProposalRow
from calib.daemon.view.api_models import Proposal
from calib.daemon.view.event_text import clean
from calib.observer.decision import Finding


def proposal_answer(row: ProposalRow) -> Proposal:
    """A proposal as the API shows it."""
    finding = finding_of(row.finding)
    gain_std, offset_std = finding.std
    return Proposal(
        id=row.id,
        time=row.time,
        state=row.state,  # type: ignore[arg-type]
        joint=row.joint,
        cause=finding.cause,
        gain=finding.gain,
        gain_std=gain_std,
        offset=finding.offset,
        offset_std=offset_std,
        rows=finding.rows,
        confidence=finding.confidence,
        record=row.record,
        base=row.base,
        decided_at=row.decided,
        decided_by=row.by,
        note=row.note,
    )


def finding_json(finding: Finding) -> dict[str, Any]:
    """A finding as JSON values."""
    names = ("joint", "cause", "gain", "offset", "rows", "confidence")
    values: dict[str, Any] = clean({name: getattr(finding, name) for name in names})
    return values | {"covariance": finding.covariance.tolist()}


def finding_of(values: dict[str, Any]) -> Finding:
    """The finding that finding_json wrote."""
    return Finding(**{**values, "covariance": np.array(values["covariance"])})
