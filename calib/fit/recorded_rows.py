"""Rows of recordings of any robot, of poses at rest or in slow motion, and of the unloaded readings of sweeps."""

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
from armlink.torque_calibration import TorqueCalibration
from calib.arm.kinematics import StatedModel
from calib.dataset import SweepData
from calib.fit.sweep_readings import sweep_readings
from calib.motion.static_reading import slope
from gcomp.arm.load import inertial_torque
from gcomp.arrays import Array, Mask
from gcomp.identify.readings import StaticReadings

WINDOW = 0.25
"""Length of a window, which is averaged to one row [s]."""
FEWEST_SAMPLES = 3
"""Samples of a window; its slope and scatter need as many."""
SLOW = 0.1
"""Largest speed of any joint in a window that counts: centrifugal torque is then below 0.1 N·m at 10 kg·m² [rad/s]."""
STEADY = 0.05
"""Largest change of any joint's speed [rad/s²] (docs/theory.md, section 6.1)."""
MOVED = 0.004
"""Motion of a joint after which its direction counts as changed [rad]."""
FEWEST_ROWS = 12
"""Rows that a recording must have: three unknowns a joint, and some more for the scatter."""


def windows_of(t: Array, position: Array, torque: Array, source: str) -> tuple[StaticReadings, Array, Mask]:
    """(Averages over windows, accelerations (W, n) [rad/s²], which windows have all joints slow and steady (W,)).

    Of times (K,) [s] with positions and torques (K, n); sigma is that of a mean, by the scatter of its torques about a
    straight line. Raises BadInput if there is no window.
    """
    windows = _windows(t)
    if not windows:
        raise BadInput(f"{source}: no window of {WINDOW} s has {FEWEST_SAMPLES} samples of every joint")
    slopes = np.array([slope(t[each], position[each]) for each in windows])
    middles = np.array([t[each].mean() for each in windows])
    change = np.abs(np.diff(slopes, axis=0)) / np.diff(middles)[:, None]
    padded = np.concatenate([change[:1], change, change[-1:]]) if len(change) else np.zeros((2, position.shape[1]))
    steady = np.maximum(padded[:-1], padded[1:]).max(axis=1) <= STEADY
    means = np.array([position[each].mean(axis=0) for each in windows])
    torques = np.array([torque[each].mean(axis=0) for each in windows])
    sigma = np.array([_scatter(t[each], torque[each]) / np.sqrt(len(t[each])) for each in windows])
    sigma = np.maximum(sigma, np.finfo(float).tiny)
    found = StaticReadings(means, torques, sigma, direction=directions(means), velocity=slopes)
    acceleration = np.array([2 * np.polyfit(t[each] - t[each].mean(), position[each], 2)[0] for each in windows])
    return found, acceleration, (np.abs(slopes).max(axis=1) <= SLOW) & steady


def rows_of_recording(recording: Recording, held: TorqueCalibration[Array], number: int, source: str) -> StaticReadings:
    """Windows of a recording in which all joints move slowly and steadily.

    `held` (n,) is what the controllers held: what they sent is turned back into the sensors' own readings. Raises
    BadInput if there is no joint torque, or nothing slow enough.
    """
    if recording.torque is None:
        raise BadInput(
            f"{source}: there is no joint torque (columns tau_1 …), but calibration needs the readings of the "
            "torque sensors"
        )
    keep = np.isfinite(recording.position).all(axis=1) & np.isfinite(recording.torque).all(axis=1)
    sent = held.apply(recording.torque[keep])
    windows, _, slow = windows_of(recording.t[keep], recording.position[keep], sent, source)
    if slow.sum() < FEWEST_ROWS:
        raise BadInput(
            f"{source}: only {int(slow.sum())} windows of {WINDOW} s are slow enough, at least {FEWEST_ROWS} are "
            f"needed: record an arm that stands still in several poses, or moves smoothly below {SLOW} rad/s"
        )
    typical = np.sqrt(np.median(windows.sigma[slow] ** 2, axis=0))
    return replace(windows.rows(slow), sigma=np.maximum(typical, 1e-6), series=np.full(slow.sum(), number))


def rows_of_sweeps(data: SweepData, number: int) -> StaticReadings:
    """The readings of a sweep at rest; raises BadInput for creep sweeps, and if a reference mass was attached."""
    if data.creeps:
        raise BadInput(f"{data.path}: these are creep sweeps: use armlink calibrate {data.path}")
    if data.manifest.reference_mass > 0:
        raise BadInput(
            f"{data.path} was swept with a reference mass of {data.manifest.reference_mass:g} kg, but the field "
            f"calibration needs the arm without a mass; sweeps with a mass are for armlink calibrate {data.path}"
        )
    readings = sweep_readings([data]).readings
    return replace(readings, series=np.full(len(readings), number))


def _windows(t: Array) -> list[slice]:
    """Windows of WINDOW seconds with enough samples and without gaps."""
    windows, begin = [], 0
    while begin < len(t):
        end = int(np.searchsorted(t, t[begin] + WINDOW))
        if end - begin >= FEWEST_SAMPLES and t[end - 1] - t[begin] >= WINDOW / 2:
            windows.append(slice(begin, end))
        begin = max(end, begin + 1)
    return windows


def _scatter(t: Array, values: Array) -> Array:
    """Standard deviation (n,) about a straight line."""
    line = np.outer(t - t.mean(), slope(t, values)) + values.mean(axis=0)
    return np.asarray(np.sqrt(((values - line) ** 2).sum(axis=0) / max(len(t) - 2, 1)))


def directions(positions: Array) -> Array:
    """Sign of each joint's last motion of at least MOVED, row by row (K, n)."""
    direction, now = np.zeros_like(positions), np.zeros(positions.shape[1])
    anchor = positions[0].copy()
    for row, here in enumerate(positions):
        moved = np.abs(here - anchor) > MOVED
        now = np.where(moved, np.sign(here - anchor), now)
        anchor = np.where(moved, here, anchor)
        direction[row] = now
    return direction


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
        found, acceleration, counted = windows_of(t[whole], position[whole], torque[whole], source)
        inertia = np.zeros_like(found.torque)
        if model.placed is not None and model.placed.arm.beta.any():
            inertia = inertial_torque(model.placed, found.position, found.velocity, acceleration)
            counted = np.ones(len(inertia), dtype=bool)
        sigma = np.hypot(INERTIA_DOUBT * inertia, EXACT)
        found = replace(found, torque=found.torque - inertia, sigma=sigma).rows(counted)
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
