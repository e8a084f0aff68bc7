"""Checks of recordings without a torque channel: times, units, and commanded against measured positions."""

from collections.abc import Sequence
from itertools import chain

import numpy as np

from armlink.errors import BadInput
from armlink.recording.corrections import Corrections
from armlink.recording.recording import TORQUE_CHANNELS, Recording
from sim_gap.checks.column_pairs import require_commands
from sim_gap.checks.finding import RecordingFinding
from sim_gap.checks.joint_range import find_beyond_range, find_counts, find_far
from sim_gap.checks.sampling import drop_repeats, even_times, find_dropped
from sim_gap.model.rigid_body import RigidArm
from sim_gap.residuals.preprocess import SHORTEST_S


def is_position_only(recording: Recording) -> bool:
    """Whether no torque channel of a recording holds a number."""
    channels = [getattr(recording, name) for name in TORQUE_CHANNELS]
    return all(values is None or not np.isfinite(values).any() for values in channels)


def check_position_only(
    arm: RigidArm, recordings: Sequence[Recording], labels: Sequence[str], stated: Corrections
) -> tuple[list[Recording], list[RecordingFinding]]:
    """Recordings on their sample times, without repeated rows, and the findings.

    Raises BadInput where commands and positions do not belong together, with the option that settles it.
    """
    checked, found = [], []
    short = [k for k, r in enumerate(recordings) if r.t[-1] - r.t[0] < SHORTEST_S]
    for k in range(len(recordings)):
        if k not in short:
            require_commands([recordings[k]], labels[k], stated)
    if short:  # together, since a lag turns what a single step seems to follow
        more = f" and {len(short) - 1} more" if len(short) > 1 else ""
        require_commands([recordings[k] for k in short], labels[short[0]] + more, stated)
    for recording, label in zip(recordings, labels, strict=True):
        if recording.position_command is None or not np.isfinite(recording.position_command).any():
            raise BadInput(
                f"{label}: no torque channel and no commanded position holds a number: record tau_1 …, "
                "tau_motor_1 … or tau_cmd_1 …, or q_cmd_1 …"
            )
        looks = (
            find_counts(recording, stated),
            find_beyond_range(arm, recording, stated),
            find_far(arm, recording, stated),
        )
        for finding in chain(*looks):
            raise BadInput(f"{label}: {finding.refusal()}")
        recording, repeated = drop_repeats(recording)
        recording, jitter = even_times(recording, stated)
        dropped = [] if repeated else find_dropped(recording)
        checked.append(recording)
        found += [finding for finding in (*repeated, *jitter, *dropped) if finding not in found]
    return checked, found
