"""Checks of recordings without a torque channel: times, units, and commanded against measured positions."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from armlink.errors import BadInput
from armlink.recording.corrections import Corrections
from armlink.recording.recording import TORQUE_CHANNELS, Recording
from gcomp.arrays import Array
from sim_gap.checks.finding import RecordingFinding, exchange_option
from sim_gap.checks.joint_range import find_beyond_range, find_counts, find_far
from sim_gap.checks.sampling import drop_repeats, even_times, find_dropped
from sim_gap.model.rigid_body import RigidArm
from sim_gap.residuals.preprocess import SHORTEST_S

FOLLOWS = 0.5
"""Correlation of a command with its joint's position below which they do not belong together."""
CLEARLY = 0.9
"""Correlation with another joint's position from which the command is that joint's."""
MOVES = 0.02
"""Standard deviation of a command from which it can be judged [rad]."""
SCALE = 0.2, 3.0
"""Slope of position over command outside which the units differ."""


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
    for several, label in _judged_together(recordings, labels):
        _require_pairs(several, label, stated)
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


def _judged_together(recordings: Sequence[Recording], labels: Sequence[str]) -> list[tuple[Recording, str]]:
    """Long recordings as they are, and short ones in one: a lag turns what a single step seems to follow."""
    long = [(r, label) for r, label in zip(recordings, labels, strict=True) if r.t[-1] - r.t[0] >= SHORTEST_S]
    short = [(r, label) for r, label in zip(recordings, labels, strict=True) if r.t[-1] - r.t[0] < SHORTEST_S]
    given = [r.position_command for r, _ in short if r.position_command is not None]
    if not given:
        return long
    position = np.concatenate([r.position for r, _ in short if r.position_command is not None])
    first, label = short[0]
    several = replace(first, position=position, position_command=np.concatenate(given))
    return [*long, (several, label if len(short) == 1 else f"{label} and {len(short) - 1} more")]


def _require_pairs(recording: Recording, label: str, stated: Corrections) -> None:
    """Raise BadInput for a command that another joint follows, or that its joint follows in another sign or unit."""
    command, position = recording.position_command, recording.position
    assert command is not None
    there = np.isfinite(command).all(axis=1) & np.isfinite(position).all(axis=1)
    x, y = command[there], position[there]
    if len(x) < 20:
        return
    match, slope = _match(x, y), _slope(x, y)
    holds = _of_others(x, match, stated)
    for j, name in enumerate(recording.names):
        if x[:, j].std() < MOVES or stated.states("order", f"q_cmd_{j + 1}"):
            continue
        column = f"q_cmd_{j + 1}"
        if (other := holds.get(j)) is not None:
            order = exchange_option("q_cmd", holds)
            remedy = (
                f"give the order with {order}"
                if order
                else (
                    f"name the right column with --map {column}=COLUMN; if {column} is right, confirm it with --map "
                    f"{column}={column}"
                )
            )
            raise BadInput(
                f"{label}: {name}: {column} is followed by q_{other + 1} (correlation {match[j, other]:.2f}), not by "
                f"q_{j + 1} ({match[j, j]:.2f}): {remedy}"
            )
        if match[j, j] < -FOLLOWS and not stated.states("sign", column):
            raise BadInput(
                f"{label}: {name}: q_{j + 1} moves in the direction opposite to {column} (correlation "
                f"{match[j, j]:.2f}): give --sign {column}=-1 or, if q has the wrong sign, --sign q_{j + 1}=-1"
            )
        if match[j, j] > CLEARLY and not SCALE[0] < slope[j] < SCALE[1] and not stated.states("units", column):
            unit = f"q_cmd_{j + 1}=deg" if slope[j] < 1.0 else f"q_{j + 1}=deg"
            raise BadInput(
                f"{label}: {name}: q_{j + 1} moves {slope[j]:.3g} times as far as {column}: if their units "
                f"differ, give --units {unit}"
            )


def _of_others(x: Array, match: Array, stated: Corrections) -> dict[int, int]:
    """Commands that another joint clearly follows, and their own does not → that joint."""
    found = {}
    for j in np.flatnonzero(x.std(0) >= MOVES).tolist():
        best = int(np.abs(match[j]).argmax())
        clear = abs(match[j, best]) > CLEARLY and abs(match[j, j]) < FOLLOWS
        if best != j and clear and not stated.states("order", f"q_cmd_{j + 1}"):
            found[j] = best
    return found


def _match(x: Array, y: Array) -> Array:
    """Correlation of each command with each position, (n, n); NaN where one does not move."""
    with np.errstate(invalid="ignore", divide="ignore"):
        n = x.shape[1]
        return np.nan_to_num(np.corrcoef(x.T, y.T)[:n, n:])


def _slope(x: Array, y: Array) -> Array:
    """Slope of each position over its command, (n,)."""
    dx, dy = x - x.mean(0), y - y.mean(0)
    return np.asarray((dx * dy).sum(0) / np.maximum((dx**2).sum(0), 1e-18))
