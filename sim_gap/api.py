"""The diagnosis for programs and notebooks; `import armlink` offers it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

from armlink.errors import BadInput
from armlink.recording.files import load_recording
from armlink.recording.recording import Recording
from sim_gap.attribution import diagnose as diagnosis
from sim_gap.attribution.diagnosis import Diagnosis

RecordingLike: TypeAlias = Recording | str | Path
"""A recording, or its path."""


def diagnose(
    model: Any,
    train: RecordingLike | Sequence[RecordingLike],
    heldout: RecordingLike | Sequence[RecordingLike] = (),
    *,
    base: str | None = None,
    tip: str | None = None,
) -> Diagnosis:
    """Explain the gap between a simulation model and recordings of the real arm.

    Args:
        model: path of an MJCF, URDF or arm file, a bundled arm's name, or a compiled `mujoco.MjModel`: the nominal arm.
        train: one or several recordings to fit, or their paths.
        heldout: recordings to judge on, which the fit does not see; by default the end of each training recording.
        base: body of the model that carries the recorded arm, such as a torso; by default the world.
        tip: body of the model that the recorded arm ends in, if it has several arms.

    Raises BadInput if the recordings cannot be used with the model.
    """
    trained, judged = _recordings("train", train), _recordings("heldout", heldout)
    labels = [label for label, _ in (*trained, *judged)]
    recordings = [recording for _, recording in trained], [recording for _, recording in judged]
    return diagnosis.diagnose(model, *recordings, labels=labels, base=base, tip=tip)


def _recordings(role: str, given: RecordingLike | Sequence[RecordingLike]) -> list[tuple[str, Recording]]:
    """(Label, recording) of each."""
    items = [given] if isinstance(given, Recording | str | Path) else given
    if not isinstance(items, Sequence):
        raise BadInput(f"diagnose: {role}: expected recordings or their paths, not {type(given).__name__}")
    found = []
    for number, each in enumerate(items, start=1):
        if isinstance(each, Recording):
            found.append((f"{role} {number}", each))
        elif isinstance(each, str | Path):
            found.append((str(each), load_recording(each)))
        else:
            raise BadInput(f"diagnose: {role}: expected recordings or their paths, not {type(each).__name__}")
    return found
