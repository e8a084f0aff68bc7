"""Labelled real recordings as cases: those of `sim_gap/blind/real_arms.yaml` whose files a folder holds."""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from armlink.arm_file import read_yaml
from armlink.errors import ArmlinkError
from armlink.recording.recording import Recording
from referee.seal import seal
from sim_gap.blind.cases import write_csv
from sim_gap.blind.real_recordings import KNOWN, recordings_of
from sim_gap.model.load import load_model

FIELDS = {
    "q": "position",
    "dq": "velocity",
    "tau": "torque",
    "tau_motor": "motor_torque",
    "tau_cmd": "torque_command",
    "q_cmd": "position_command",
}


LEAST_S = 6.0
"""Least length of a held-out recording [s] (measure.py)."""


def draw_real(folder: Path, out: Path, key: bytes, cpu_seconds: float) -> dict[str, str]:
    """Write the cases whose files are there; names and hashes of the sealed parts. Arms whose
    model is no MJCF that is complete by itself are left out."""
    hashes = {}
    for known in read_yaml(KNOWN):
        name = f"real_{known['case']}"
        try:
            train, heldout, _ = recordings_of(folder, known)
            model = load_model(str(folder / known["sim"]), (), train[0].n)
            text = (folder / known["sim"]).read_text(encoding="utf-8")
            mujoco.MjModel.from_xml_string(text)
        except (ArmlinkError, OSError, ValueError):
            continue
        if known.get("refused") or not heldout or np.ptp(heldout[0].t) < LEAST_S:
            continue
        first, place = train[0], out / "cases" / name
        joints = [model.mujoco_model.joint(joint).name for joint in model.joints]
        kind = (
            "torque" if first.torque is not None else "motor_torque" if first.motor_torque is not None else "positions"
        )
        place.mkdir()
        (place / "sim.xml").write_text(text, encoding="utf-8")
        for k, recording in enumerate(train, start=1):
            write_csv(place / f"train_{k}.csv", columns_of(recording))
        told = {"joints": joints, "kind": kind, "withheld": [], "cpu_seconds": cpu_seconds}
        (place / "case.json").write_text(json.dumps(told), encoding="utf-8")
        held = {channel: np.asarray(values).tolist() for channel, values in columns_of(heldout[0]).items()}
        label = {"case": name, "stratum": "real recordings", "joints": joints, **label_of(known, kind)}
        hashes[name] = seal(out / "sealed", name, {"label": label, "heldout": held}, key)
    return hashes


def columns_of(recording: Recording) -> dict[str, Any]:
    channels = {name: getattr(recording, field) for name, field in FIELDS.items()}
    return {"t": recording.t - recording.t[0], **{name: x for name, x in channels.items() if x is not None}}


def label_of(known: dict[str, Any], kind: str) -> dict[str, Any]:
    """What is known of the arm: one of `first` has to come first; what nobody knows is no false cause."""
    nothing: dict[str, Any] = {"joints": [], "implied": [], "undecided": "", "confused_with": []}
    first = [{"effect": effect, **nothing} for effect in known["first"]]
    others = [*known["has"], *known.get("open", ())]
    return {
        "kind": kind,
        "plant": "real",
        "real": True,
        "effects": first,
        "nearest": others,
        "outside": False,
        "withheld": [],
        "truth": [],
    }
