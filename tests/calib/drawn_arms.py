"""Arms drawn as widely as issue by issue they are promised to work, swept whole on the simulated bus, and judged."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rank_test import undetermined
from sweep_arms import arm_content, largest_torque

from armlink.arm_file import ArmFile, load_arm, parse_arm
from armlink.link.link import Link
from calib.arm.kinematics import gcomp_arm
from calib.dataset import SweepData
from calib.fit.gravity_fit import identify_gravity
from calib.fit.sensor_fit import SensorFit, fit_sensors
from calib.records.records import PARAMETERS
from calib.sweep.run import run_sweep
from gcomp.gravity.torque import gravity_torque
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth, flange

Array = np.ndarray
GAIN, OFFSET, GRAVITY = 0.005, 0.003, 0.005
"""Largest errors: of a gain, of an offset as a share of rated torque, gravity RMS as a share of the largest torque."""
BUNDLED = ("sarcos", "parallel6")
FRICTION, OFFSET_RANGE = 0.05, 0.2
"""Coulomb friction and largest offset (10 % of the sensor's range of ± 2 rated torques), as shares of rated torque."""


@dataclass(frozen=True)
class Verdict:
    """What one arm's two passes came to."""

    arm: ArmFile
    truth: Truth
    data: list[SweepData]
    fit: SensorFit
    gain: float
    offset: float
    gravity: float
    inside: list[bool]
    missed: set[tuple[str, str]]
    """Parameters that the rank test says are lost and the fit gives a value to."""
    invented: set[tuple[str, str]]
    """Parameters that the fit calls lost and that the rank test finds."""
    wrong: list[str] = field(default_factory=list)


def drawn_arm(seed: int, n: int | None = None, *, upright: bool | None = None, **sweep: Any) -> tuple[ArmFile, Truth]:
    """A random arm of 3 to 7 joints with its hidden truth; about one in four stands upright."""
    random = np.random.default_rng([seed, 77])
    n = 3 + seed % 5 if n is None else n
    alphas = [float(random.choice([0.0, np.pi / 2, -np.pi / 2, random.uniform(-2.5, 2.5)])) for _ in range(n)]
    middle, half = random.uniform(-0.8, 0.8, n), random.uniform(0.75, 2.4, n)
    stands = random.random() < 0.25 if upright is None else upright
    down = np.array([0.0, 0.0, -1.0]) if stands else random.normal(size=3)
    joints = [
        {
            "name": f"j{i + 1}",
            "a": float(random.choice([0.0, random.uniform(-0.4, 0.4)])),
            "alpha": alphas[i],
            "d": float(random.choice([0.0, random.uniform(-0.4, 0.4)])),
            "theta_offset": float(random.uniform(-1, 1)),
            "lower": float(middle[i] - half[i]),
            "upper": float(middle[i] + half[i]),
        }
        for i in range(n)
    ]
    masses = np.linspace(random.uniform(3, 8), random.uniform(0.8, 2.0), n)
    links = [
        {"mass": float(m), "com": random.uniform(-0.15, 0.15, 3).tolist(), "inertia": [0.01 * m + 0.002] * 3}
        for m in masses
    ]
    drives: list[dict[str, Any]] = [
        {"name": f"j{i + 1}", "node": i + 1, "rated_torque": 50.0, "max_torque": 80.0} for i in range(n)
    ]
    content = arm_content(f"drawn{seed}", 9.80665 * down / np.linalg.norm(down), joints, drives, links)
    if sweep:
        content["sweep"] = sweep
    largest = largest_torque(content, random.uniform(middle - half, middle + half, (300, n)))
    headroom = random.uniform(1.5, 2.2)
    for drive, torque in zip(drives, largest, strict=True):
        limit = float(max(headroom * torque, 0.08 * largest.max(), 2.0))
        drive |= {"max_torque": limit, "rated_torque": limit / 1.4, "max_torque_rate": 4 * limit}
    content["sim"]["effects"] = [
        {"effect": "friction.coulomb", "joint": drive["name"], "torque": FRICTION * float(drive["rated_torque"])}
        for drive in drives
    ]
    content["sim"]["sensors"] = {"bits": [int(bits) for bits in random.integers(12, 17, n)]}
    arm = parse_arm(content, Path(f"drawn{seed}.yaml"))
    return arm, drawn_truth(arm, seed)


def drawn_truth(arm: ArmFile, seed: int) -> Truth:
    """Gains 0.7 to 1.3, offsets ± 10 % of the sensors' range, position gains 0.98 to 1.02, mass up to 0.15 m aside."""
    random, n = np.random.default_rng([seed, 78]), len(arm.joint_names)
    rated = arm.require_link().rated_torques
    return Truth(
        gain=random.uniform(0.7, 1.3, n),
        offset=random.uniform(-OFFSET_RANGE, OFFSET_RANGE, n) * rated,
        position_gain=random.uniform(0.98, 1.02, n),
        position_offset=np.zeros(n),
        attachment=flange(arm) + np.array([*random.uniform(-0.15, 0.15, 2), 0.0]),
    )


def asked_arm(which: str, *, upright: bool | None = None) -> tuple[ArmFile, Truth]:
    """An arm that the sweeps' bounds are asked on, upright if told: bundled, or drawn by the number of its seed."""
    if which not in BUNDLED:
        return drawn_arm(int(which), upright=upright)
    arm = load_arm(which)
    if upright:
        arm = arm.model_copy(update={"kinematics": arm.kinematics.model_copy(update={"gravity": (0, 0, -9.80665)})})
    return arm, drawn_truth(arm, 1)


def sweep(simulated: SimulatedArm, out: Path, *, loaded: bool = True) -> list[SweepData]:
    """The pass without and, if asked for, the pass with the mass that the plan recommends."""
    arm = simulated.arm
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        link.enable()
        data = [run_sweep(link, arm, out / "bare")]
        if loaded:
            assert data[0].plan is not None
            mass = data[0].plan.reference_mass
            simulated.attach_mass(mass)
            data.append(run_sweep(link, arm, out / "loaded", reference_mass=mass))
            simulated.detach_mass()
    return data


def judge(arm: ArmFile, truth: Truth, data: list[SweepData], fit: SensorFit | None = None) -> Verdict:
    """Errors of the fit against the truth, and its unobservable parameters against the rank test."""
    fit = fit_sensors(arm, data) if fit is None else fit
    rated = arm.require_link().rated_torques
    off = np.abs(fit.value("gain") / truth.gain - 1)
    gain = float(np.nanmax(off, initial=0.0))
    told = np.array([name in fit.imprecise for name in fit.names])  # known worse than asked, and said so
    width = 1.5 * fit.half95("gain") / np.abs(truth.gain)
    beyond = off > np.where(told, np.maximum(width, GAIN), GAIN)
    loosest = float(np.max(width, where=told, initial=GRAVITY))
    offset = float(np.nanmax(np.abs(fit.value("offset") - truth.offset) / rated, initial=0.0))
    inside = [
        bool(low <= true <= high)
        for parameter in PARAMETERS
        for (low, high), true in zip(fit.ci95(parameter), getattr(truth, parameter), strict=True)
        if parameter != "position_offset" and np.isfinite(low)
    ]
    gravity = gravity_error(arm, truth, data, fit)
    lost = undetermined(arm, data)
    named = {(joint, parameter) for joint, parameter in fit.reasons if parameter in ("gain", "offset", "position_gain")}
    hopeless = {tuple(reversed(name.rstrip("]").split("["))) for name in fit.fit.hopeless}
    missed, invented = lost - named, named - lost - hopeless
    wrong = [f"gain {gain:.2%}"] * bool(beyond.any()) + [f"offset {offset:.2%}"] * (offset > OFFSET)
    wrong += [f"gravity {gravity:.2%}"] * (gravity > loosest)
    wrong += [f"missed {sorted(missed)}"] * bool(missed) + [f"invented {sorted(invented)}"] * bool(invented)
    return Verdict(arm, truth, data, fit, gain, offset, gravity, inside, missed, invented, wrong)


def gravity_error(arm: ArmFile, truth: Truth, data: list[SweepData], fit: SensorFit) -> float:
    """Largest RMS over the joints of model minus true gravity torque, as a share of the joint's largest torque."""
    if np.isnan(fit.value("gain")).all():
        return 0.0
    gravity = identify_gravity(arm, data, fit)
    described = gcomp_arm(arm)
    poses = np.random.default_rng(5).uniform(described.lower, described.upper, (300, described.n))
    true = SimulatedArm(arm, truth).gravity_torque(poses)
    error = np.sqrt(((gravity_torque(described, gravity.beta, poses) - true) ** 2).mean(axis=0))
    largest = np.abs(true).max(axis=0)
    felt = largest > 1e-6
    return float((error[felt] / largest[felt]).max(initial=0.0))
