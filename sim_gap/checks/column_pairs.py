"""Columns of recorded velocity and commanded position beside those of the measured position: joint, sign and unit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlink.errors import BadInput
from armlink.recording.corrections import Corrections
from armlink.recording.recording import Recording
from gcomp.arrays import Array, Mask
from gcomp.estimate.linear_terms import PRICE
from sim_gap.checks.finding import Kind, RecordingFinding, exchange_option

SAME, ALIKE, APART = 0.9, 0.7, 0.5
"""Correlation from which two columns are the same motion; from which most columns of a channel are the positions';
below which two columns do not belong together."""
MOVES = 0.02
"""Standard deviation of a column from which it can be judged [rad, rad/s]."""
VELOCITY_SCALE, COMMAND_SCALE = (0.7, 1.4), (0.33, 5.0)
"""Velocity over derivative of the position, and command over position, outside which units differ: a servo may be soft,
or go on beyond its command."""
LATE_S, LATE_ROWS = 0.04, 1.5
"""Delay of the recorded velocity from which it is filtered: both in seconds and in rows."""


@dataclass(frozen=True, eq=False)
class ColumnPairs:
    """Columns of a channel beside those of the same joints' motion."""

    match: Array
    """Correlation of each column with each joint's motion, (n, n); zero where one does not move."""
    slope: Array
    """Column over its own joint's motion, (n,)."""
    judged: Mask
    scale: tuple[float, float]

    @property
    def in_scale(self) -> Mask:
        return (self.scale[0] < self.slope) & (self.slope < self.scale[1])

    @property
    def alike(self) -> bool:
        """Whether most columns go with their joints, in the same unit."""
        same = (np.diag(self.match) > ALIKE) & self.in_scale
        return bool(self.judged.any() and np.mean(same[self.judged]) > 0.5)

    def holds(self, column: int) -> int:
        return int(np.abs(self.match[column]).argmax())

    def wrong(self) -> dict[Kind, list[int]]:
        """Columns that are certainly another joint's, of the opposite sign, or in another unit."""
        size, own = np.abs(self.match), np.diag(self.match)
        wrong: dict[Kind, Mask] = {
            "order": (size.max(1) > SAME) & (np.abs(own) < APART),
            "sign": own < -APART,
            "scale": (own > SAME) & ~self.in_scale,
        }
        return {kind: np.flatnonzero(columns & self.judged).tolist() for kind, columns in wrong.items()}


def column_pairs(values: Array, motion: Array, scale: tuple[float, float]) -> ColumnPairs:
    """Columns (K, n) of a channel and of its joints' motion."""
    there = np.isfinite(values).all(axis=1) & np.isfinite(motion).all(axis=1)
    count = max(int(there.sum()), 1)
    x, y = (each[there] - each[there].sum(0) / count for each in (values, motion))
    products, size, own = x.T @ y, np.maximum((x**2).sum(0), 1e-18), np.maximum((y**2).sum(0), 1e-18)
    match, spread = products / np.sqrt(size[:, None] * own), np.sqrt(np.maximum(size, own) / count)
    return ColumnPairs(match, np.diag(products) / own, spread > MOVES, scale)


def velocity_pairs(recording: Recording, velocity: Array) -> ColumnPairs:
    return column_pairs(velocity, np.gradient(recording.position, recording.t, axis=0), VELOCITY_SCALE)


def follows_position(recording: Recording) -> tuple[str, ...]:
    """Channels of `dq` and `q_cmd` whose columns go with those of the position as they are."""
    found, command = [], recording.position_command
    if recording.velocity is not None and velocity_pairs(recording, recording.velocity).alike:
        found.append("dq")
    if command is not None and column_pairs(command, recording.position, VELOCITY_SCALE).alike:
        found.append("q_cmd")
    return tuple(found)


def sound_velocity(recording: Recording, stated: Corrections) -> tuple[Recording, list[RecordingFinding]]:
    """The recording, its velocity left out if it is not the derivative of the position."""
    velocity, names = recording.velocity, recording.names
    if velocity is None:
        return recording, []
    pairs, found = velocity_pairs(recording, velocity), list[RecordingFinding]()
    for kind, wrong in pairs.wrong().items():
        stating = "sign" if kind == "sign" else "units"
        joints = [j for j in wrong if not stated.states(stating, f"dq_{j + 1}")]
        if not joints:
            continue
        listed = ", ".join(f"{names[j]} {pairs.slope[j]:.3g} times" for j in joints)
        value = "-1" if kind == "sign" else "deg"
        option = f"--{stating} " + ",".join(f"dq_{j + 1}={value}" for j in joints)
        what = "differs in size from the derivative of the position"
        if kind == "sign":
            what = "has the opposite sign of the derivative of the position"
        elif kind == "order":
            what = "belongs to another joint"
            listed = ", ".join(f"{names[j]} holds {names[pairs.holds(j)]}" for j in joints)
            kept = "--units " + ",".join(f"dq_{j + 1}=rad" for j in joints) + " (to keep the velocity)"
            option = exchange_option("dq", {j: pairs.holds(j) for j in joints}) or kept
        evidence = f"the velocity {what} ({listed}), so it is left out of the diagnosis"
        joint = "all" if len(joints) == pairs.judged.sum() else names[joints[0]]
        found.append(RecordingFinding(kind, "dq", joint, evidence, option, True))
    if not found and not stated.states("units", "dq_1") and (late := _delay(recording, velocity, pairs)):
        evidence = (
            f"the velocity lags {late * 1e3:.0f} ms behind the derivative of the position, as after a filter, so it is "
            "left out"
        )
        found = [RecordingFinding("filter", "dq", "all", evidence, "--units dq=rad (to keep the velocity)", True)]
    return (replace(recording, velocity=None), found) if found else (recording, [])


def _delay(recording: Recording, velocity: Array, pairs: ColumnPairs) -> float:
    """Delay of the velocity behind the position's derivative [s], 0 where it is too short to matter."""
    rate, period = np.gradient(recording.position, recording.t, axis=0), float(np.median(np.diff(recording.t)))
    there = np.isfinite(rate).all(axis=1) & np.isfinite(velocity).all(axis=1)
    same = pairs.judged & (np.diag(pairs.match) > SAME)
    rate, velocity = rate[there][:, same], velocity[there][:, same] / pairs.slope[same]
    if not same.any():
        return 0.0
    longest = max(2, min(len(rate) // 4, round(0.3 / period)))
    size = np.sqrt(np.mean(rate**2, axis=0))
    squares = [(((velocity[k:] - rate[: len(rate) - k]) / size) ** 2).sum(1) for k in range(longest)]
    rows = int(np.argmin([each.mean() for each in squares]))
    better = squares[0][rows:] - squares[rows]
    chance = np.sqrt(2.0 * (PRICE + np.log(longest))) * better.std() / np.sqrt(len(better))
    return rows * period if better.mean() > chance and rows > LATE_ROWS and rows * period > LATE_S else 0.0


def require_commands(recordings: Sequence[Recording], label: str, stated: Corrections) -> None:
    """Raise BadInput for a command that another joint follows, or that its joint follows in another sign or unit."""
    commands = [r.position_command for r in recordings if r.position_command is not None]
    if sum(map(len, commands)) < 20:
        return
    position = np.concatenate([r.position for r in recordings if r.position_command is not None])
    pairs, names = column_pairs(np.concatenate(commands), position, COMMAND_SCALE), recordings[0].names
    wrong: dict[Kind, list[int]] = {
        kind: [j for j in joints if not stated.states("units" if kind == "scale" else kind, f"q_cmd_{j + 1}")]
        for kind, joints in pairs.wrong().items()
    }
    exchange = exchange_option("q_cmd", {j: pairs.holds(j) for j in wrong["order"]})
    for kind, joints in wrong.items():
        for j in joints:
            column, match, other = f"q_cmd_{j + 1}", pairs.match[j], pairs.holds(j)
            if stated.states("order", column):
                continue
            if kind == "order":
                confirmed = (
                    f"name the right column with --map {column}=COLUMN; if {column} is right, confirm it with --map "
                    f"{column}={column}"
                )
                remedy = f"give the order with {exchange}" if exchange else confirmed
                what = f"{column} belongs to q_{other + 1} (correlation {match[other]:.2f}), not to q_{j + 1} "
                what += f"({match[j]:.2f})"
            elif kind == "sign":
                remedy = f"give --sign {column}=-1 or, if q has the wrong sign, --sign q_{j + 1}=-1"
                what = f"q_{j + 1} moves in the direction opposite to {column} (correlation {match[j]:.2f})"
            else:
                unit = f"{column}=deg" if pairs.slope[j] > 1.0 else f"q_{j + 1}=deg"
                remedy = f"if their units differ, give --units {unit}"
                what = f"q_{j + 1} moves {1.0 / pairs.slope[j]:.3g} times as far as {column}"
            raise BadInput(f"{label}: {names[j]}: {what}: {remedy}")
