"""Readings of poses, at rest or in slow motion, from recordings of any robot."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from armlink.errors import BadInput
from armlink.recording.corrections import Corrections
from armlink.recording.files import load_recordings
from armlink.recording.recording import COLUMNS, TORQUE_CHANNELS, Recording, default_names, take_joints
from calib.arm.stated_model import StatedModel
from calib.fit.slow_windows import FEWEST_ROWS, SLOW, WINDOW, directions, windows_of
from gcomp.arm.load import inertial_torque
from gcomp.identify.readings import StaticReadings

INERTIA_DOUBT = 0.3
"""Standard deviation of the inertia of a model's links, as a share: about that of the errors of sound arms' models
(sim_gap.checks.sound_arm)."""
EXACT = 1e-9
"""Doubt about a reading of which nothing but its scatter is known [N·m]."""


def channel_of(recording: Recording, source: str) -> str:
    """The channel of torque that poses are read from; raises BadInput where there is none."""
    for name in TORQUE_CHANNELS:
        values = getattr(recording, name)
        if values is not None and np.isfinite(values).any():
            return name
    wanted = ", ".join(f"{COLUMNS[name]}_1 …" for name in TORQUE_CHANNELS[:2])
    raise BadInput(f"{source}: no column of torques or currents: expected {wanted} (--map, --units)")


def in_joint_order(recording: Recording, names: tuple[str, ...], source: str) -> Recording:
    """The joints of the model, by name where the recording names them all; raises BadInput for another number."""
    if set(names) <= set(recording.names) and recording.names != default_names(recording.n):
        return take_joints(recording, [recording.names.index(name) for name in names])
    if recording.n != len(names):
        raise BadInput(
            f"{source}: {recording.n} joints ({', '.join(recording.names)}), but the model has {len(names)} "
            f"({', '.join(names)}): name the arm's joints with --joints, or the last body of its chain with --tip"
        )
    return recording


def pose_readings(
    recording: Recording, channel: str, model: StatedModel, number: int, load: float, source: str
) -> StaticReadings:
    """One row a pose. Rows further apart than a window are poses on their own; of others, windows are averaged.

    In a table of poses a joint came from where it was in the row above, or as its velocity column says. Where the model
    has inertials, its torques of inertia are taken off windows of motion and doubted; else only slow windows count.
    """
    torque = getattr(recording, channel)
    keep = np.isfinite(recording.position).all(axis=1) & np.isfinite(torque).any(axis=1)
    t, position, torque = recording.t[keep], recording.position[keep], torque[keep]
    if len(t) > 1 and np.median(np.diff(t)) >= WINDOW:
        velocity = np.zeros_like(position) if recording.velocity is None else np.nan_to_num(recording.velocity[keep])
        slow = np.abs(velocity).max(axis=1) <= SLOW
        side = np.where(velocity != 0, np.sign(velocity), directions(position))
        found = StaticReadings(position, torque, np.full(position.shape[1], EXACT), direction=side, velocity=velocity)
        found = found.rows(slow)
    else:
        whole = np.isfinite(torque).all(axis=1)
        windows = windows_of(t[whole], position[whole], torque[whole], source)
        inertia = np.zeros_like(windows.torque)
        counted = windows.slow
        if model.placed is not None and model.placed.arm.beta.any():
            inertia = inertial_torque(model.placed, windows.position, windows.velocity, windows.acceleration)
            counted = np.ones(len(inertia), dtype=bool)
        found = StaticReadings(
            windows.position,
            windows.torque - inertia,
            np.hypot(INERTIA_DOUBT * inertia, EXACT),
            direction=windows.direction,
            velocity=windows.velocity,
        ).rows(counted)
    count = len(found)
    return replace(found, load=np.full(count, load), series=np.full(count, number, dtype=np.int64))


def load_poses(
    paths: Sequence[Path],
    model: StatedModel,
    masses: Mapping[str, float] = MappingProxyType({}),
    stated: Corrections | None = None,
) -> tuple[StaticReadings, str, dict[str, str]]:
    """(Readings, channel of torque, SHA-256 of each source) of recordings and tables of poses, numbered as `series`.

    `masses`: path → reference mass that hung at the tip [kg]. Raises BadInput.
    """
    if stated is not None and stated.without_gravity:
        raise BadInput("--effort-is without-gravity: the efforts do not contain gravity, so they show no masses")
    parts, sources, channel = list[StaticReadings](), dict[str, str](), ""
    for path in paths:
        for label, loaded in load_recordings(path, stated, poses=True).items():
            recording = in_joint_order(loaded, model.arm.names, label)
            found = channel_of(recording, label)
            if channel and found != channel:
                raise BadInput(
                    f"{label} has torque in {COLUMNS[found]}_1 …, but {next(iter(sources))} has torque in "
                    f"{COLUMNS[channel]}_1 …: give files with one of them, since each has its own gain and friction"
                )
            channel = found
            parts.append(pose_readings(recording, channel, model, len(parts), masses.get(str(path), 0.0), label))
            values = getattr(recording, channel)
            digest = hashlib.sha256(np.ascontiguousarray(np.hstack([recording.position, values])).tobytes()).hexdigest()
            if digest in sources.values():
                twin = next(name for name, known in sources.items() if known == digest)
                raise BadInput(f"{label} contains the same data as {twin}, which would count twice: leave one out")
            sources[label] = digest
    readings = parts[0].joined(*parts[1:])
    if len(readings) < FEWEST_ROWS:
        raise BadInput(
            f"{', '.join(sources)}: {len(readings)} poses, but at least {FEWEST_ROWS} are needed: record an arm that "
            f"stands still in several poses, or moves smoothly below {SLOW} rad/s"
        )
    readings.require_arm(model.arm)
    if not np.nanmax(np.abs(readings.torque)) > 0:
        raise BadInput(f"{next(iter(sources))}: every torque is 0")
    return readings, channel, sources
