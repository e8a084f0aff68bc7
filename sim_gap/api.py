"""The diagnosis for programs and notebooks; `import armlink` offers it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from armlink.errors import BadInput
from armlink.recording.corrections import Corrections, parse_corrections
from armlink.recording.files import load_recording
from armlink.recording.recording import Recording
from sim_gap.attribution import diagnose as diagnosis
from sim_gap.attribution.diagnosis import Diagnosis

RecordingLike: TypeAlias = Recording | str | Path
"""A recording, or its path."""
Stated: TypeAlias = Mapping[str, str | float] | Sequence[str]
"""Statements about columns: `{"q": "deg"}`, or in the words of the command, `["q=deg"]`."""


def diagnose(
    model: Any,
    train: RecordingLike | Sequence[RecordingLike],
    heldout: RecordingLike | Sequence[RecordingLike] = (),
    *,
    base: str | None = None,
    tip: str | None = None,
    units: Stated = (),
    sign: Stated = (),
    zero: Stated = (),
    clock: Stated = (),
    columns: Stated = (),
    joints: Sequence[str] = (),
    effort_is: str = "",
    topic: str = "",
) -> Diagnosis:
    """Explain the gap between a simulation model and recordings of the real arm.

    Args:
        model: path of an MJCF, URDF or arm file, a bundled arm's name, or a compiled `mujoco.MjModel`: the nominal arm.
        train: one or several recordings to fit, or their paths.
        heldout: recordings to judge on, which the fit does not see; by default the end of each training recording.
        base: body of the model that carries the recorded arm, such as a torso; by default the world.
        tip: body of the model that the recorded arm ends in, if it has several arms.
        units: of columns or channels, as `armlink gap diagnose --units` has them: `{"q": "deg", "tau": "A:2.1"}`.
        sign: as `--sign`: `{"tau_3": -1}`.
        zero: as `--zero`: `{"q_2": 1.571}` [rad].
        clock: as `--clock`: `{"tau": 0.02}` [s].
        columns: as `--map`, for a table with other names.
        joints: the recorded joints in the model's order.
        effort_is: whether the torque channel is of the motor or the link, and whether gravity is missing in it.
        topic: the joint states in a bag.

    Raises BadInput if the recordings cannot be used with the model.
    """
    given = {"columns": columns, "sign": sign, "units": units, "zero": zero, "clock": clock}
    words = {
        option: [f"{column}={value}" for column, value in each.items()] if isinstance(each, Mapping) else each
        for option, each in given.items()
    }
    stated = parse_corrections(header="", **words, effort_is=effort_is, joints=",".join(joints), topic=topic)
    trained, judged = (_recordings(*each, stated.of_reading()) for each in (("train", train), ("heldout", heldout)))
    labels = [label for label, _ in (*trained, *judged)]
    recordings = [recording for _, recording in trained], [recording for _, recording in judged]
    return diagnosis.diagnose(model, *recordings, labels=labels, stated=stated, base=base, tip=tip)


def _recordings(
    role: str, given: RecordingLike | Sequence[RecordingLike], reading: Corrections
) -> list[tuple[str, Recording]]:
    """(Label, recording) of each."""
    items = given if isinstance(given, Sequence) and not isinstance(given, str) else [given]
    for each in items:
        if not isinstance(each, Recording | str | Path):
            raise BadInput(f"diagnose: {role}: expected recordings or their paths, not {type(each).__name__}")
    return [
        (f"{role} {k}", each) if isinstance(each, Recording) else (str(each), load_recording(each, reading))
        for k, each in enumerate(items, start=1)
    ]
