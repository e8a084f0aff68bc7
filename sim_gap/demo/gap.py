"""The demo's gap diagnosis, which runs in another process."""

from pathlib import Path

from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.model.load import compiled


def diagnose_recordings(arm_path: Path, recordings: tuple[Recording, Recording]) -> Diagnosis:
    """The recordings against the arm's nominal model."""
    return diagnose(compiled(arm_path), recordings[:1], recordings[1:], labels=["train", "heldout"])
