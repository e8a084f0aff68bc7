"""Excitation that separates effects: planned within the arm file's ranges and speeds, kept as a file, run on the arm.

Pieces move single joints and all together. A file of planned motion is CSV with columns t [s] and q_cmd_1 … q_cmd_n
[rad]; it is checked against the arm when it is read.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from armlink.arm_file import ArmFile
from armlink.content.atomic_file import open_whole, writing
from armlink.errors import BadInput
from armlink.extras import require_extra
from armlink.link.types import Setpoints
from armlink.loop.open import ArmDriver
from armlink.recording.csv_text import load_columns, write_numbers
from calib.arm.kinematics import gcomp_arm
from calib.motion.trajectory import WorkMotion, trajectory, way_and_rest
from gcomp.arrays import Array

SPEEDS = (0.03, 0.1, 0.3, 0.6)
"""Constant speeds, as shares of a joint's max_velocity."""
MOVES = WorkMotion(speed_share=0.5, acceleration=1.0, rest=1.0)
"""Moves between poses, for drives with little torque in excess of gravity."""
LONGEST = 25.0
"""Longest time for one pass through the range [s]: at creeping speed only a part of it is covered."""
TONES, BAND, FADE_S = 4, (0.08, 0.6), 2.0
"""Number of sines per joint in the motion of all joints, their frequency band [Hz], and time of their rise and fall
[s]."""


class PlannedMotion:
    """Position targets of an arm, one per cycle, from the middle of all ranges on, 12 % of each range from its ends."""

    def __init__(self, arm: ArmFile) -> None:
        section, described = arm.require_link(), gcomp_arm(arm)
        self.names, self.rate = described.names, float(section.rate)
        room = 0.12 * (described.upper - described.lower)
        self.low, self.high = described.lower + room, described.upper - room
        self.fastest = np.array([joint.max_velocity for joint in section.joints])
        self.here = (self.low + self.high) / 2
        self.rows: list[Array] = [self.here[None]]
        self.pieces: list[str] = []
        """Description of each part."""

    @property
    def target(self) -> Array:
        """(K, n) [rad]."""
        return np.concatenate(self.rows)

    @property
    def seconds(self) -> float:
        return len(self.target) / self.rate

    def go(self, goal: Array, motion: WorkMotion = MOVES) -> None:
        """Move to a pose (n,) [rad], all joints arriving together, and rest there."""
        self.rows.append(way_and_rest(self.here, goal, self.fastest, 1 / self.rate, motion))
        self.here = goal

    def turn(self, joint: int, pose: Array) -> None:
        """Move one joint through its range at each constant speed, both directions, the others at `pose` (n,) [rad]."""
        for share in SPEEDS:
            middle, half = (self.low[joint] + self.high[joint]) / 2, (self.high[joint] - self.low[joint]) / 2
            half = min(half, share * self.fastest[joint] * LONGEST / 2)
            for end in (middle - half, middle + half, middle - half):
                goal = pose.copy()
                goal[joint] = end
                there = np.allclose(np.delete(self.here, joint), np.delete(goal, joint))
                self.go(goal, replace(MOVES, speed_share=share) if there else MOVES)
        self.pieces.append(
            f"{self.names[joint]} alone, {len(SPEEDS)} speeds in both directions, the other joints at "
            f"{np.round(pose, 2)}"
        )

    def sines(self, joints: list[int], random: np.random.Generator, seconds: float = 60.0) -> None:
        """Move the joints together, each by its own sum of sines about the middle of its range."""
        self.go((self.low + self.high) / 2)
        reach, speed = (x[joints] for x in (0.45 * (self.high - self.low), MOVES.speed_share * self.fastest))
        t = np.arange(round(seconds * self.rate)) / self.rate
        rows = np.repeat(self.here[None], len(t), axis=0)
        rows[:, joints] += multisine(t, reach, speed, BAND, random.random((len(joints), 2, TONES)))
        self.rows.append(rows)
        self.here = rows[-1]
        self.pieces.append(f"all joints together, {TONES} sines for each joint, {seconds:g} s")


def plan_motion(arm: ArmFile, joints: Iterable[str] = (), poses: int = 2, seed: int = 0) -> PlannedMotion:
    """Each joint (or those named) alone, slow and fast in both directions, with the others in `poses` poses; then all.

    Constant speeds from creeping to fast separate the kinds of friction, reversals under two loads separate friction
    from load-dependent effects and backlash, and the sines of all joints separate inertia, rotor and lag. Raises
    BadInput for a joint that the arm does not have.
    """
    motion = PlannedMotion(arm)
    names = list(motion.names)
    for joint in joints:
        if joint not in names:
            raise BadInput(f"there is no joint {joint} in arm {arm.name}: its joints are {', '.join(names)}")
    chosen = [names.index(joint) for joint in dict.fromkeys(joints)] or list(range(len(names)))
    random = np.random.default_rng(seed)
    for pose in range(poses):
        share = random.uniform(0.15, 0.85, len(names)) if pose else np.full(len(names), 0.5)
        for number in chosen:
            motion.turn(number, motion.low + share * (motion.high - motion.low))
    motion.sines(chosen, random)
    return motion


def multisine(t: Array, reach: Array, speed: Array, band: tuple[float, float], draw: Array) -> Array:
    """Way from a middle (K, n) [rad], from rest to rest at even times: of each joint sines with frequencies of a band
    [Hz], within its reach [rad] and speed [rad/s], (n,), and MOVES' acceleration; by random numbers (n, 2, sines).
    """
    omega = 2 * np.pi * (band[0] + (band[1] - band[0]) * draw[:, 0])
    size = np.minimum(np.minimum(reach[:, None], speed[:, None] / omega), MOVES.acceleration / omega**2) / draw.shape[2]
    fade = np.clip(np.minimum(t, t[-1] + t[1] - t) / FADE_S, 0.0, 1.0)
    fade = fade * fade * (3 - 2 * fade)
    return np.asarray(fade[:, None] * (size * np.sin(t[:, None, None] * omega + 2 * np.pi * draw[:, 1])).sum(axis=2))


def joints_in_doubt(answer: Path) -> tuple[list[str], list[str]]:
    """Undecided joints of a diagnosis, and the motions that it requests, from its JSON; raises BadInput."""
    try:
        result: dict[str, Any] = json.loads(answer.read_text(encoding="utf-8"))
        causes, where = result["causes"], result["where"]
        open_causes = [cause for cause in causes if cause["confounded_with"]]
        joints = [joint for cause in open_causes or causes for joint in cause["joints"]]
        joints = joints or [place["joint"] for place in where]
        return list(dict.fromkeys(joints)), [cause["separate_by"] for cause in open_causes if cause["separate_by"]]
    except OSError as error:
        raise BadInput(f"{answer}: cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        raise BadInput(f"{answer}: this is not a result that gap diagnose wrote with --json") from None


def save_motion(motion: PlannedMotion, path: Path) -> None:
    """Write `.csv`; raises BadInput if it cannot be written."""
    if path.suffix != ".csv":
        raise BadInput(f"{path}: a motion is written as .csv")
    target = motion.target
    columns = {"t": np.arange(len(target)) / motion.rate}
    columns |= {f"q_cmd_{i + 1}": column for i, column in enumerate(target.T)}
    with writing(path), open_whole(path) as stream:
        write_numbers(stream, columns)


def load_motion(path: Path, arm: ArmFile) -> Array:
    """Targets (K, n) [rad], one per cycle of the arm's rate, from a CSV with columns t and q_cmd_i (others ignored).

    Raises BadInput if the motion does not fit the arm: columns, missing values, time, range, speed.
    """
    described, section = gcomp_arm(arm), arm.require_link()
    t, *target = load_columns(path, ["t", *(f"q_cmd_{i + 1}" for i in range(described.n))]).T
    if len(t) < 2 or not (np.diff(t) > 0).all():
        raise BadInput(f"{path}: column t does not increase from row to row: expected seconds, at least two rows")
    even: Array = np.arange(t[0], t[-1], 1.0 / section.rate)
    rows: Array = np.column_stack([np.interp(even, t, column) for column in target])
    for column, name, low, high, limits in zip(
        rows.T, described.names, described.lower, described.upper, section.joints, strict=True
    ):
        if column.min() < low or column.max() > high:
            raise BadInput(
                f"{path}: {name} goes from {column.min():.3f} to {column.max():.3f} rad, beyond its range {low:.3f} to "
                f"{high:.3f} rad: plan the motion for this arm with armlink gap plan {arm.argument} --out {path}"
            )
        fastest = float(np.abs(np.diff(column)).max()) * section.rate
        if fastest > 1.05 * limits.max_velocity:  # a file's numbers are rounded
            raise BadInput(
                f"{path}: {name} turns at {fastest:.3f} rad/s, but its max_velocity is {limits.max_velocity:.3f} "
                f"rad/s: plan the motion for this arm with armlink gap plan {arm.argument} --out {path}"
            )
    return rows


def collect(
    link: ArmDriver, target: Array, out: str | Path, progress: Callable[[int, int], None] = lambda k, n: None
) -> int:
    """Move to the first target, follow all targets under position control, record each cycle; returns the row count.

    The caller starts and enables the link, which stops the joints safely in every case. A kill loses at most the last
    second of the recording. Raises BusFault, Refused.
    """
    require_extra(str(out), "bags")
    from armlink.recording.mcap import RecordingWriter

    section = link.arm.require_link()
    speed = MOVES.speed_share * np.array([joint.max_velocity for joint in section.joints])
    way = trajectory(link.position_sent, target[0], speed, np.full(link.n, MOVES.acceleration), link.period)
    for _ in link.play(Setpoints.follow(way)):
        pass
    start: float | None = None
    with RecordingWriter(out, link.names) as writer:
        for k, sample in enumerate(link.play(Setpoints.follow(target))):
            start = sample.t if start is None else start
            channels = {
                "position": sample.position,
                "velocity": sample.velocity,
                "torque": sample.torque,
                "motor_torque": sample.motor_torque,
                "torque_command": link.torque_sent,
                "position_command": target[k],
            }
            writer.append(sample.t - start, channels)
            progress(k + 1, len(target))
    return len(target)
