"""Drawn arms at rest in drawn poses, as MuJoCo holds them: tables of poses, and how well gravity comes out of them."""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pinocchio

from calib.arm.kinematics import stated_model
from calib.arm.model_files import write_model
from calib.commands.identify_poses import Judged, judged_fit
from gcomp.gravity.torque import gravity_torque
from sim_gap.blind.arms import BenchArm, draw_arm, mjcf

Array = np.ndarray
TEST_POSES = 400
LEAST = 1e-6
"""Torque that is rounding of MuJoCo's [N·m]."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """One drawn arm, its tables of poses, and what is hidden."""

    model: Path
    tables: list[Path]
    masses: dict[str, float]
    gain_std: float | None
    truth: BenchArm
    both_sides: bool
    gains: bool


def holding_torque(arm: BenchArm, q: Array) -> Array:
    """Torque (K, n) that holds the arm at rest, by MuJoCo [N·m]."""
    model = mujoco.MjModel.from_xml_string(mjcf(arm))
    data, out = mujoco.MjData(model), np.empty(q.shape)
    for row, pose in enumerate(q):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        out[row] = data.qfrc_bias
    return out


def draw(seed: int, folder: Path) -> Drawn:
    """An arm whose centres of mass are not where its model has them, with friction; every second one has wrong gains
    and offsets, and a known mass in half of its poses. 30 to 200 poses, reached from one side or from both."""
    random = np.random.default_rng([seed, 6])
    while True:
        nominal = draw_arm(random)
        truth = nominal
        for link in range(nominal.n):
            truth = truth.with_moved(link, random.normal(0.0, 0.03, 3) * nominal.mass[link])
        n, count = nominal.n, int(random.integers(30, 201))
        q = random.uniform(nominal.lower, nominal.upper, (count, n))
        bare = holding_torque(truth, q)
        if np.abs(bare).max() > 1.0:  # not all axes are vertical
            break
    both, gains = bool(random.random() < 0.5), seed % 2 == 0
    largest = np.maximum(np.abs(bare).max(axis=0), 0.02 * np.abs(bare).max())
    gain = 1.0 + gains * random.normal(0.0, 0.1, n)
    offset = gains * random.normal(0.0, 0.03, n) * largest.max()
    mass, point = random.uniform(1.0, 4.0), random.normal(0.0, 0.08, 3)
    about_origin = mass * ((1e-3 + point @ point) * np.eye(3) - np.outer(point, point))
    heavier = truth.with_added(n - 1, mass, mass * point, about_origin)
    coulomb, load = random.uniform(0.01, 0.1, n) * largest, random.uniform(0.0, 0.1, n)
    uneven = random.normal(0.0, 0.05, n)
    noise = random.uniform(0.002, 0.02, n) * largest
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(mjcf(nominal))
    tables = [folder / "poses.csv"] + [folder / "loaded.csv"] * gains
    parts = np.array_split(q, len(tables))
    for path, part, body in zip(tables, parts, (truth, heavier), strict=False):
        sides = np.array([1.0, -1.0] if both else [1.0])
        rest, side = np.repeat(part, len(sides), axis=0), np.tile(sides, len(part))[:, None]
        torque = np.repeat(holding_torque(body, part), len(sides), axis=0)
        friction = (side + uneven) * (coulomb + load * np.abs(torque))
        reading = gain * (torque + friction) + offset + noise * random.standard_normal(rest.shape)
        header = ",".join(f"{name}_{i + 1}" for name in ("q", "dq", "tau") for i in range(n))
        speed = 1e-6 * side * np.ones_like(rest)  # the sign alone counts: where the joint came from
        np.savetxt(path, np.hstack([rest, speed, reading]), delimiter=",", header=header, comments="")
    masses = {str(folder / "loaded.csv"): mass} if gains else {}
    return Drawn(folder / "model.xml", tables, masses, 0.5 if gains else 0.0, truth, both, gains)


@dataclass(frozen=True, eq=False)
class Outcome:
    """RMS error of each joint's gravity at test poses, its bound, and its own size (n,) [N·m]."""

    error: Array
    bound: Array
    size: Array
    pinocchio: float
    """Largest difference of Pinocchio's torque in the written URDF from the fitted gravity [N·m]."""
    judged: Judged

    @property
    def inside(self) -> Array:
        return self.error <= self.bound + LEAST


def outcome(drawn: Drawn, seed: int) -> Outcome:
    """Identify, judge against the hidden arm at poses of its own, write the URDF and ask Pinocchio."""
    model = stated_model(str(drawn.model))
    judged = judged_fit(model, drawn.tables, [], drawn.masses, drawn.gain_std)
    random = np.random.default_rng([seed, 7])
    q = random.uniform(drawn.truth.lower, drawn.truth.upper, (TEST_POSES, drawn.truth.n))
    beta, true = judged.fit.gravity.beta, holding_torque(drawn.truth, q)
    found = gravity_torque(model.arm, beta, q)
    urdf = drawn.model.with_suffix(".urdf")
    assert model.placed is not None
    assert model.path is not None
    write_model(model.placed, model.path, beta, urdf)
    made = pinocchio.buildModelFromUrdf(str(urdf))
    made.gravity.linear = np.array(drawn.truth.gravity)
    data = made.createData()
    theirs = np.array([pinocchio.computeGeneralizedGravity(made, data, pose).copy() for pose in q])
    error, size = (np.sqrt(np.mean(each**2, axis=0)) for each in (found - true, true))
    return Outcome(error, judged.fit.bound(q), size, float(np.abs(theirs - found).max()), judged)
