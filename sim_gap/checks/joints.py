"""Joints of a recording and joints of the model, matched by name where the recording has names."""

import re
from collections.abc import Sequence
from dataclasses import replace

from armlink.errors import BadInput
from armlink.recording.corrections import Corrections
from armlink.recording.recording import Recording, default_names, take_joints
from sim_gap.checks.finding import RecordingFinding

FILLERS = {"joint", "joints", "jnt", "motor", "link", "arm", "robot", "actuator", "axis", "j", "pos"}
"""Words of joint names that say nothing about which joint it is."""


def match_joints(
    recording: Recording, model: Sequence[str], stated: Corrections, label: str
) -> tuple[Recording, list[RecordingFinding]]:
    """The recording's joints in the order of the model's (base to tip), named as there, and a finding where names were
    matched that differ. Raises BadInput where it is not certain which joint is which.

    With `joints` stated, those are the model's, whatever they are called; without names the columns' order counts.
    """
    own = recording.names
    if stated.joints:
        return (replace(recording, names=tuple(model)) if len(own) == len(model) else recording), []
    known = [name for name in model if name in own]
    if known and (len(known) == len(model) or len(known) == len(own)):
        return _taken(recording, known, known), []
    if own == default_names(recording.n):
        return recording, []
    matched = _by_words(own, model)
    if matched is None and any(column.startswith("q_") for column in stated.columns):
        return replace(recording, names=default_names(recording.n)), []  # the order is that of --map
    if matched is None:
        raise BadInput(
            f"{label}: the recording has the joints ({', '.join(own)}), but the model has "
            f"({', '.join(model)}): name the joints of the recording in the order of the model, for example "
            f"--joints {','.join(own[: len(model)])}"
        )
    pairs = ", ".join(f"{name} as {to}" for to, name in matched.items())
    finding = RecordingFinding(
        "order", "q", "all", f"the joints were matched by name: {pairs}", "--joints " + ",".join(matched.values()), True
    )
    return _taken(recording, list(matched.values()), list(matched)), [finding]


def _taken(recording: Recording, names: Sequence[str], called: Sequence[str]) -> Recording:
    left = [name for name in recording.names if name not in names]
    taken = take_joints(recording, [recording.names.index(name) for name in names], tuple(called))
    note = f"joints left out because the model does not have them: {', '.join(left)}" if left else ""
    return replace(taken, warning="; ".join(filter(None, (recording.warning, note))))


def _by_words(own: Sequence[str], model: Sequence[str]) -> dict[str, str] | None:
    """Model joint → recorded joint, where each model joint has exactly one recorded one with its words."""
    words = {name: _words(name) for name in own}
    matched = {}
    for name in model:
        wanted = _words(name)
        if not wanted:
            return None
        equal = [other for other in own if words[other] == wanted]
        near = equal or [other for other in own if words[other] and (words[other] > wanted or words[other] < wanted)]
        if len(near) != 1:
            return None
        matched[name] = near[0]
    return matched if len(set(matched.values())) == len(model) else None


def _words(name: str) -> frozenset[str]:
    """Words and numbers of a joint's name that tell it from others."""
    parts = re.findall(r"[a-z]+|\d+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())
    return frozenset(part.lstrip("0") or "0" if part.isdigit() else part for part in parts) - FILLERS
