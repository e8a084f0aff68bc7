"""Arms for the tests of sweeps: random ones, and data sets drawn from MuJoCo's gravity without any motion."""

from pathlib import Path
from typing import Any

import numpy as np

from armlink.arm_file import ArmFile, parse_arm
from calib.dataset import Manifest, SweepData
from calib.motion.static_reading import StaticReading
from calib.plan.types import SweepPlan
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

SAMPLES = 40
RESOLUTION = 2 * np.pi / 2**16


def random_arm(seed: int, n: int, *, headroom: float = 1.8, vertical: bool = False, **sections: Any) -> ArmFile:
    """A random arm of n joints whose drives can hold `headroom` times the largest gravity torque."""
    random = np.random.default_rng([seed, n])
    alphas = [random.choice([0.0, np.pi / 2, -np.pi / 2, random.uniform(-2.0, 2.0)]) for _ in range(n)]
    middle, half = random.uniform(-0.8, 0.8, n), random.uniform(0.9, 1.5, n)
    down = np.array([0.0, 0.0, -1.0]) if vertical else random.normal(size=3)
    joints = [
        {
            "name": f"j{i + 1}",
            "a": float(random.uniform(-0.35, 0.35)),
            "alpha": float(alphas[i]),
            "d": float(random.uniform(-0.2, 0.2)),
            "theta_offset": float(random.uniform(-1, 1)),
            "lower": float(middle[i] - half[i]),
            "upper": float(middle[i] + half[i]),
        }
        for i in range(n)
    ]
    links = [
        {
            "mass": float(mass),
            "com": random.uniform(-0.12, 0.12, 3).tolist(),
            "inertia": [0.02 * mass, 0.02 * mass, 0.02 * mass],
        }
        for mass in np.linspace(5.0, 1.2, n)
    ]
    drives = [{"name": f"j{i + 1}", "node": i + 1, "rated_torque": 50.0, "max_torque": 80.0} for i in range(n)]
    content = {**arm_content(f"random{seed}", 9.81 * down / np.linalg.norm(down), joints, drives, links), **sections}
    largest = largest_torque(content, random.uniform(middle - half, middle + half, (200, n)))
    for drive, torque in zip(drives, largest, strict=True):
        limit = max(headroom * float(torque), 3.0)
        drive |= {"max_torque": limit, "rated_torque": 0.7 * limit, "max_torque_rate": 4 * limit}
    friction = [
        {"effect": "friction.coulomb", "joint": drive["name"], "torque": 0.02 * float(drive["rated_torque"])}
        for drive in drives
    ]
    content["sim"] = {"links": links, "effects": friction}
    return parse_arm(content, Path(f"random{seed}.yaml"))


def arm_content(name: str, gravity: np.ndarray, joints: list, drives: list, links: list) -> dict[str, Any]:
    """An arm file of these parts."""
    return {
        "name": name,
        "kinematics": {"gravity": gravity.tolist(), "joints": joints},
        "link": {"joints": drives},
        "sim": {"links": links},
    }


def largest_torque(content: dict[str, Any], poses: np.ndarray) -> np.ndarray:
    """Largest gravity torque of an arm file's joints at poses (P, n) [rad], (n,) [N·m]."""
    arm = parse_arm(content, Path(f"{content['name']}.yaml"))
    return np.asarray(np.abs(SimulatedArm(arm, Truth.of(arm)).gravity_torque(poses)).max(axis=0))


def reading_of(t: float, shown: np.ndarray, torque: np.ndarray, noise: np.ndarray, motor: np.ndarray) -> StaticReading:
    """A static reading of SAMPLES samples, of a position that is quiet."""
    quiet = np.zeros(len(shown))
    return StaticReading.of(t, shown, torque, count=SAMPLES, position_std=quiet, torque_std=noise, motor_torque=motor)


def with_section(arm: ArmFile, **section: Any) -> ArmFile:
    """The same arm with these keys in its sweep section."""
    from calib.arm.sweep_section import SweepSection

    return arm.model_copy(update={"sweep": SweepSection(**section)})


def at_rate(arm: ArmFile, rate: float) -> ArmFile:
    """The same arm with this many cycles a second."""
    return arm.model_copy(update={"link": arm.require_link().model_copy(update={"rate": rate})})


def synthetic_pass(arm: ArmFile, truth: Truth, plan: SweepPlan, mass: float, random: np.random.Generator) -> SweepData:
    """What the plan's readings would be: MuJoCo's gravity through the truth's sensors, noise 0.2 % of rated torque."""
    simulated = SimulatedArm(arm, truth)
    if mass:
        simulated.attach_mass(mass)
    n = len(arm.joint_names)
    noise = 0.002 * arm.require_link().rated_torques
    rows: list[tuple[str, int, int | None, int, np.ndarray, tuple[bool, ...]]] = [
        ("scout", index, None, 0, np.array(pose), (True,) * n) for index, pose in enumerate(plan.scout)
    ]
    for sweep in plan.sweeps:
        for index in range(sweep.readings):
            target, direction = sweep.target(index)
            pose = np.array(sweep.rest)
            pose[sweep.joint] = target
            rows.append((sweep.name, index, sweep.joint, direction, pose, sweep.servo))
    readings = []
    for sweep_name, index, joint, direction, pose, servo in rows:
        angle = pose + random.normal(0, 3e-4, n)
        shown = np.rint(angle / truth.position_gain / RESOLUTION) * RESOLUTION
        torque = simulated.gravity_torque(angle)[0]
        reading = truth.gain * torque + truth.offset + random.normal(0, noise / np.sqrt(SAMPLES))
        readings.append(
            reading_of(float(len(readings)), shown, reading, noise, torque).within(
                sweep_name, index, np.array(servo), joint, direction
            )
        )
    manifest = Manifest.of(arm, mass)
    return SweepData(Path(f"pass-{mass:g}"), manifest, tuple(readings), plan, np.full(n, RESOLUTION), "0" * 64)
