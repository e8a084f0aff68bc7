"""Which sensor parameters sweeps determine, by the rank of the stacked problem, written from nothing of gcomp's.

Readings v = k·τ(c·φ + θ0) + o; τ by plain transforms and moments of point forces; every column by central differences.
"""

import numpy as np

from armlink.arm_file import ArmFile
from calib.dataset import SweepData

Array = np.ndarray
LOST = 1e-6
"""Size of a parameter's part in a unit vector of the null space from which it counts as lost."""


def undetermined(arm: ArmFile, data: list[SweepData]) -> set[tuple[str, str]]:
    """(joint, parameter) that can change without changing any reading of these data sets, position offsets known."""
    n = len(arm.joint_names)
    rows = [(each.manifest.reference_mass, reading) for each in data for reading in each.readings]
    position = np.array([reading.position for _, reading in rows])
    mass = np.array([load for load, _ in rows])
    counts = np.array([np.array(reading.servo) | (np.arange(n) == reading.joint) for _, reading in rows])
    random = np.random.default_rng(0)
    generic = np.concatenate([random.uniform(0.8, 1.2, n), random.normal(size=n), random.uniform(0.99, 1.01, n)])
    moments, point = random.uniform(0.5, 2.0, 4 * n), random.normal(0, 0.2, 3)
    start = np.concatenate([generic, moments, point])

    def readings(x: Array) -> Array:
        k, o, c, m, r = x[:n], x[n : 2 * n], x[2 * n : 3 * n], x[3 * n : 7 * n].reshape(n, 4), x[7 * n :]
        value: Array = (k * torques(arm, c * position, m, mass, r) + o)[counts]
        return value

    step, columns = 1e-5, []
    for index in range(len(start)):
        forward, back = start.copy(), start.copy()
        forward[index] += step
        back[index] -= step
        columns.append((readings(forward) - readings(back)) / (2 * step))
    jacobian = np.array(columns).T
    size = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / np.where(size > 1e-7 * size.max(), size, np.inf)
    _, values, basis = np.linalg.svd(scaled, full_matrices=True)
    rank = int((values > 1e-8 * values[0]).sum())
    share = np.linalg.norm(basis[rank:], axis=0)
    names = [(joint, parameter) for parameter in ("gain", "offset", "position_gain") for joint in arm.joint_names]
    return {name for name, part in zip(names, share[: 3 * n], strict=True) if part > LOST}


def torques(arm: ArmFile, q: Array, moments: Array, load: Array, point: Array) -> Array:
    """Holding torques (K, n) [N·m] at angles (K, n), links given as (mass, mass·com) (n, 4) in bar frames."""
    gravity, rows = np.array(arm.kinematics.gravity), arm.kinematics.joints
    n = len(rows)
    here, origin = np.tile(np.eye(3), (len(q), 1, 1)), np.zeros((len(q), 3))
    axes, origins, weights, firsts = [], [], [], []
    for i, row in enumerate(rows):
        axes.append(here[:, :, 2])
        origins.append(origin)
        turn = here @ _about_z(q[:, i] + row.theta_offset)
        hung = load if i == n - 1 else np.zeros(len(q))
        mass = (moments[i, 0] + hung)[:, None]
        first = moments[i, 1:] + hung[:, None] * point
        weights.append(mass)
        firsts.append(mass * origin + np.einsum("kab,kb->ka", turn, first))
        origin = origin + turn @ np.array([row.a, 0.0, row.d])
        here = turn @ _about_x(row.alpha)
    torque = np.empty((len(q), n))
    for i in range(n):
        lever = sum(firsts[j] - weights[j] * origins[i] for j in range(i, n))
        torque[:, i] = -np.einsum("ka,ka->k", axes[i], np.cross(lever, gravity))
    return torque


def _about_z(angle: Array) -> Array:
    turn = np.zeros((len(angle), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
    turn[:, 1, 0] = np.sin(angle)
    turn[:, 0, 1] = -turn[:, 1, 0]
    turn[:, 2, 2] = 1.0
    return turn


def _about_x(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
