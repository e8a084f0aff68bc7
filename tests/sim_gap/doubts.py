"""Findings of a check that are not certain: they name what settles them, and the recording is diagnosed as it is."""

import re
from collections.abc import Sequence

from armlink.recording.recording import Recording
from sim_gap.checks.finding import RecordingFinding


def doubt(checked: tuple[Recording, Sequence[RecordingFinding]], pattern: str) -> str:
    """The sentence of the doubt of a check that holds `pattern`; there is no other kind of doubt."""
    doubts = [each for each in checked[1] if not each.corrected]
    assert len({each.finding for each in doubts}) == 1, doubts
    sentences = [sentence for each in doubts if re.search(pattern, sentence := each.sentence())]
    assert sentences, [each.sentence() for each in doubts]
    return sentences[0]
