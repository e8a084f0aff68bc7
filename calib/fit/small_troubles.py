"""Small troubles of a real arm as columns: what each would change in the torque readings (docs/theory.md, 4.6).

A family is one kind of trouble; its coefficients on all joints are drawn from one normal distribution of unknown
level. Units are chosen so that a level of 1 is what good arms have.

A sensor's reading lags behind torque, a cable's pull behind the joint's turn, each as a play: it stays until the end of
the play takes it along. Joints that are held keep the lag that their last change left. What no named trouble explains
is a Gaussian field over joint positions, as a few columns.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from calib.fit.sweep_readings import SweepReadings
from calib.plan.types import APPROACH
from gcomp.arm.arm import Arm, bar_frames
from gcomp.arm.mass_moments import base_parameter_names
from gcomp.arrays import Array, Mask
from gcomp.gravity.torque import composite_moments
from gcomp.identify.parameters import Parameters
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import joint_positions, predict, row_moments

FIELD_REST = 1e-2
"""Share of the field's variance that may be left out of its columns; it is added to the noise by the caller."""


@dataclass(frozen=True, eq=False)
class PositionField:
    """A field of unit level, expanded in landmark poses: φ(q) φ(q')ᵀ = its covariance, up to FIELD_REST."""

    landmarks: Array
    """Poses (L, n) [rad]."""
    length: float
    """Distance over which the field is alike [rad]."""
    root: Array
    """Inverse of the Cholesky factor of the landmarks' covariance (L, L)."""

    @classmethod
    def over(cls, poses: Array, length: float) -> "PositionField":
        """The field for poses (K, n) [rad], by pivoted Cholesky decomposition."""
        chosen, left = list[int](), np.ones(len(poses))
        rows = np.zeros((0, len(poses)))
        while len(chosen) < len(poses) and left.max() > FIELD_REST:
            pivot = int(np.argmax(left))
            row = kernel(poses[pivot : pivot + 1], poses, length)[0] - rows[:, pivot] @ rows
            row /= np.sqrt(left[pivot])
            rows = np.vstack([rows, row])
            left = left - row**2
            left[[*chosen, pivot]] = 0.0
            chosen.append(pivot)
        landmarks = poses[chosen]
        square = kernel(landmarks, landmarks, length) + 1e-9 * np.eye(len(chosen))
        return cls(landmarks, length, np.linalg.inv(np.linalg.cholesky(square)))

    def columns(self, poses: Array) -> Array:
        """φ at poses (K, n) → (K, L)."""
        return kernel(poses, self.landmarks, self.length) @ self.root.T


def kernel(one: Array, other: Array, length: float) -> Array:
    """Correlation (K, M) of a field of this length [rad] at poses (K, n) and (M, n) [rad].

    The squared distance of poses is Σ_l (2 sin(Δ_l/2))² = 2 Σ_l (1 − cos Δ_l), a turn of a joint being none.
    """
    cos, sin = np.cos(one) @ np.cos(other).T, np.sin(one) @ np.sin(other).T
    square = np.maximum(2 * (one.shape[1] - cos - sin), 0.0)
    return np.asarray(np.exp(-square / (2 * length**2)))


TURNS = (0.1, 0.3, 0.8)
"""Half widths of a cable's play in a joint's turn [rad]: short and long ones, between which real ones lie; the longest
for a cable that this joint bends less than another."""
TORQUE = 5e-4
"""Half width of a sensor's play, as a share of rated torque: accuracy class 0.05."""
STEPS = 4
"""Points on a straight way at which the torque is computed."""


@dataclass(frozen=True, eq=False)
class Lags:
    """Place of each play at K readings, -1 to 1; all zeros where the way is not known."""

    cable: Array
    """Of each of TURNS and joint (3, K, n)."""
    sensor: Array
    """Of each joint's torque sensor (K, n)."""

    @classmethod
    def unknown(cls, count: int, n: int) -> "Lags":
        """Of readings whose way is not known."""
        return cls(np.zeros((len(TURNS), count, n)), np.zeros((count, n)))

    @classmethod
    def of(cls, arm: Arm, rows: SweepReadings, parameters: Parameters, rated: Array) -> "Lags":
        """On straight ways between the readings, each approached from the side that it tells; rated (n,) [N·m]."""
        position, load = rows.readings.position, rows.readings.load
        approach = position - APPROACH * rows.readings.direction * rows.own
        way = np.stack([approach, position], axis=1).reshape(-1, arm.n)
        cable = np.array([play(way, np.full(arm.n, width))[1::2] for width in TURNS])
        before = np.vstack([way[:1], way[:-1]])
        shares = np.arange(1, STEPS + 1) / STEPS
        finer = (before[:, None] + shares[:, None] * (way - before)[:, None]).reshape(-1, arm.n)
        nothing = np.zeros((len(finer), arm.n))
        loads = np.repeat(load, 2 * STEPS)
        torque = predict(arm, parameters, StaticReadings.of(finer, nothing, 1.0, loads)) - parameters.offset
        sensor = play(torque / np.where(parameters.gain == 0, 1.0, parameters.gain), TORQUE * rated)
        return cls(cable, -sensor[2 * STEPS - 1 :: 2 * STEPS])


def play(values: Array, half: Array) -> Array:
    """How far values (K, n), one after the other, are ahead of a play of half widths (n,), in these (K, n)."""
    held, ahead = values[0].copy(), np.empty_like(values)
    for row, value in enumerate(values):
        held = np.minimum(np.maximum(held, value - half), value + half)
        ahead[row] = value - held
    return ahead / half


UNITS = {
    "axes": (6e-4, "rad"),
    "upright": (6e-4, "rad, of a mass moment that gravity would not show otherwise"),
    "eccentricity": (2.2e-4, "rad"),
    "sag": (3e-4, "rad at rated torque"),
    "crosstalk": (2.5e-3, "1"),
    "nonlinear": (2.5e-4, "at rated torque"),
    "spring": (1.2e-3, "of rated torque per rad"),
    "direction": (3.5e-4, "of rated torque"),
    "drift": (4.5e-4, "of rated torque"),
    "field": (3e-4, "of rated torque"),
}
"""Families with the size of a coefficient of 1: the root mean square that published sizes of good arms come to
(sim_bus.effects.realism has the sources). Axes are off by ± 1 mrad at most, an eccentricity of 0.3 mrad has two
coefficients, zeros warm up by two fifths during sweeps of ten minutes, lags of 0.05 % each are shared by several
columns."""
FAMILIES = tuple(UNITS)
LARGEST = np.array([{"upright": 100.0, "field": 25.0}.get(family, 5.0) for family in FAMILIES])
"""Largest level of each family. Bad arms have 3; what asks for more than 5 is not small: it stands out, is named and
taken out. Of an upright arm, the moments that a tilt makes felt are of a size that is not known beforehand."""
BASE = 2.0
"""Tilt of the base over the tilt of one axis against the next."""
REST = 0.2
"""Where a cable is at rest: standard deviation from the middle of the range [rad]."""
HELD, ROUGHLY = 1.2, 0.4
"""Standard deviation, in levels of `direction`, of what a sensor and a cable lag where the way is not known: anywhere
between both sides, each by 0.05 % of rated torque (twice (0.58 · 1.4)²); and during a sweep, where the way is roughly
known but not the widths of the plays. That part is the same in the whole sweep: readings do not average it out."""
BESIDE = 0.5
"""Bend of a cable per turn of the joint beside it, over that of its own."""
WAVES = 5
"""Terms of the drift in time."""


@dataclass(frozen=True, eq=False)
class Troubles:
    """Columns of P readings for m coefficients."""

    columns: Array
    """Change of each reading per coefficient, in units of the family (P, m) [N·m]."""
    family: npt.NDArray[np.int64]
    """Index in FAMILIES of each coefficient (m,)."""
    kept: Mask
    """Which of all columns these are: those that change some reading."""


@dataclass(frozen=True, eq=False)
class Setting:
    arm: Arm
    rated: Array
    """Rated torques (n,) [N·m]."""
    fields: tuple[PositionField, ...]
    """One a joint."""
    span: tuple[float, float]
    """First and last time of the readings [s]."""
    lags: Lags
    """Of sensors and cables at the readings."""


def troubles(setting: Setting, rows: SweepReadings, parameters: Parameters, keep: Mask | None = None) -> Troubles:
    """All small troubles at the counted readings of `rows`, linearised at parameters.

    `keep` chooses columns; default: those that change some reading.
    """
    counted = rows.readings.counted
    found = [(family, change[counted] * UNITS[family][0]) for family, change in _dense(setting, rows, parameters)]
    for joint, field in enumerate(setting.fields):
        here = counted[:, joint]
        values = np.zeros((*counted.shape, field.root.shape[0]))
        values[here, joint] = setting.rated[joint] * field.columns(rows.readings.position[here])
        found += [("field", column) for column in values[counted].T * UNITS["field"][0]]
    if keep is None:
        keep = np.array([np.abs(column).max(initial=0.0) > 0 for _, column in found])
    kept = [each for each, wanted in zip(found, keep, strict=True) if wanted]
    return Troubles(
        np.column_stack([np.zeros((int(counted.sum()), 0)), *(column for _, column in kept)]),
        np.array([FAMILIES.index(family) for family, _ in kept], dtype=np.int64),
        keep,
    )


def _dense(setting: Setting, rows: SweepReadings, parameters: Parameters) -> Iterator[tuple[str, Array]]:
    """(Family, change of all readings (K, n) per unit) of every named trouble."""
    arm, readings, rated = setting.arm, rows.readings, setting.rated
    n, gain = arm.n, parameters.gain
    frames = bar_frames(arm, joint_positions(parameters, readings))
    composite = composite_moments(frames.rotation, row_moments(arm, parameters, readings.load))
    torque = np.einsum("kid,kid->ki", frames.lever, composite)
    felt = np.where(np.isnan(rows.felt), torque, (rows.felt - parameters.offset) / gain)
    turned = np.cross(frames.rotation[..., 2], composite)
    along = readings.load[:, None] * _along_axes(arm, parameters.rho)
    whole = composite + along[:, :, None] * frames.rotation[..., 2]  # β takes what the links' own moments along do

    def turn(joint: int, axis: Array) -> Array:
        """Change of true torque as all from a joint on turns about an axis (K, 3) [N·m/rad]."""
        beyond = np.einsum("kd,kid->ki", np.cross(axis, arm.gravity), turned)
        before = np.einsum("kid,kd->ki", frames.lever, np.cross(axis, whole[:, joint]))
        return np.asarray(np.where(np.arange(n) >= joint, beyond, before))

    upright = n - len(base_parameter_names(arm)) // 2  # leading joints along gravity, whose moments nothing tells
    unseen = float(np.sqrt((torque**2).mean(axis=0)).max()) / float(np.linalg.norm(arm.gravity))

    def swung(joint: int, axis: Array, moment: Array, upto: int) -> Array:
        """The same (K, n) by a moment (K, 3) [kg·m] fixed to link `upto`, which acts as the joint's axis turns."""
        felt_by = np.cross(frames.rotation[..., 2], moment[:, None])
        change = np.einsum("kd,kid->ki", np.cross(axis, arm.gravity), felt_by)
        return np.where((np.arange(n) >= joint) & (np.arange(n) <= upto), change, 0.0)

    for joint in range(n):
        base = BASE if joint == 0 else 1.0
        for axis in _crossing(arm, frames.rotation, joint):
            yield "axes", gain * turn(joint, axis) * base
            for link, across in product(range(joint, upright), range(2)):
                moment = unseen * frames.rotation[:, link, :, across]
                change = gain * swung(joint, axis, moment, link) * base
                yield "upright", change
        stiffness = gain * turn(joint, frames.rotation[:, joint, :, 2])
        angle = readings.position[:, joint]
        yield "eccentricity", stiffness * np.sin(angle)[:, None]
        yield "eccentricity", stiffness * np.cos(angle)[:, None]
        yield "sag", stiffness * felt[:, joint, None] / rated[joint]
        if joint < n - 1:
            for across in range(3):  # a length: where the load hangs beyond this link
                shift = np.einsum("kid,kd->ki", frames.lever, frames.rotation[:, joint, :, across])
                reach = np.where(np.arange(n) <= joint, shift, 0.0) * readings.load[:, None]
                yield "axes", gain * reach
    own, bare = np.eye(n), np.ones((len(torque), 1))
    middle = (arm.lower + arm.upper) / 2
    since = _waves(rows.time, setting.span)
    for joint, here in enumerate(own):
        for other in {joint - 1, joint + 1} & set(range(n)):
            yield "crosstalk", here * gain[joint] * felt[:, other, None]
        share = torque[:, joint, None] / rated[joint]
        yield "nonlinear", here * gain[joint] * rated[joint] * share**3
        for other in {joint - 1, joint, joint + 1} & set(range(n)):
            bent = readings.position[:, other, None] - middle[other]
            yield "spring", here * gain[joint] * rated[joint] * bent
        yield "spring", here * gain[joint] * rated[joint] * REST * bare
        side = np.where(rows.swept == joint, readings.direction[:, joint], 0.0)[:, None]
        yield "direction", here * rated[joint] * side
        yield "direction", here * rated[joint] * setting.lags.sensor[:, joint, None]
        for lag in setting.lags.cable:
            yield "direction", here * rated[joint] * lag[:, joint, None]
            for other in {joint - 1, joint + 1} & set(range(n)):
                beside = BESIDE * lag[:, other, None]
                yield "direction", here * rated[joint] * beside
        share = (readings.position[:, joint] - middle[joint])[:, None] / ((arm.upper - arm.lower)[joint] / 2)
        for bend in (share, 1.5 * share**2 - 0.5, 2.5 * share**3 - 1.5 * share):
            yield "direction", here * rated[joint] * side * bend
        for number in range(len(rows.sweeps)):
            during = (readings.series == number) & (rows.swept >= 0)
            moved = (during & (rows.swept == joint))[:, None]
            scale = here * rated[joint]
            yield "direction", scale * ROUGHLY * (during[:, None] & ~moved)
            yield "direction", scale * ROUGHLY * moved
            yield "direction", scale * ROUGHLY * side * moved
        for wave in since:
            yield "drift", here * gain[joint] * rated[joint] * wave[:, None]


def _along_axes(arm: Arm, rho: Array) -> Array:
    """Moment of a unit mass at ρ (3,) [m] along each joint's axis, from the origin on it (n,) [m]; section 2.1."""
    along = np.empty(arm.n)
    along[-1] = rho[2]
    for link in reversed(range(arm.n - 1)):
        along[link] = np.cos(arm.alpha[link]) * along[link + 1] + arm.span[link, 2]
    return along


def _crossing(arm: Arm, rotation: Array, joint: int) -> tuple[Array, Array]:
    """Two axes (K, 3) across a joint's, fixed to the link before it."""
    if joint == 0:
        fixed = np.broadcast_to(np.eye(3), (len(rotation), 3, 3))
        return fixed[..., 0], fixed[..., 1]
    before, twist = rotation[:, joint - 1], arm.alpha[joint - 1]
    return before[..., 0], np.cos(twist) * before[..., 1] + np.sin(twist) * before[..., 2]


def _waves(time: Array, span: tuple[float, float]) -> Array:
    """Terms (WAVES, K) of a random walk of unit variance over the span that ends at zero at its end."""
    back = (span[1] - time) / max(span[1] - span[0], 1e-9)
    rate = (np.arange(1, WAVES + 1) - 0.5)[:, None] * np.pi
    return np.asarray(np.sqrt(2) * np.sin(rate * back) / rate)
