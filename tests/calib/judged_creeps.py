"""Drawn arms without torque sensors, swept on the simulated bus and judged: creep, steps at rest, nominal model."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from drawn_arms import drawn_arm

from armlink.arm_file import ArmFile, parse_arm
from armlink.arrays import Array
from armlink.link.link import Link
from calib.arm.kinematics import gcomp_arm
from calib.dataset import SweepData
from calib.fit.calibration import QUANTILE
from calib.fit.creep_fit import CreepFit, fit_creep
from calib.fit.gravity_fit import identify_gravity
from calib.fit.sensor_fit import fit_sensors
from calib.plan.creep_plan import plan_creep
from calib.plan.rough_gravity import is_vertical
from calib.plan.types import SweepPlan
from calib.sweep.run import run_sweep
from gcomp.arm.mass_moments import base_parameters
from gcomp.gravity.torque import gravity_torque
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

MODELS = (("DM4310", 3.0, 6.5), ("DM4340", 9.0, 22.0), ("DM8009", 20.0, 36.0))
"""Smallest first: model, rated and largest torque [N·m]."""
GAINS = {"DM4310": (15.0, 1.0), "DM4340": (50.0, 5.0), "DM8009": (80.0, 5.0)}
GAIN, COULOMB_SHARE, COULOMB, GRAVITY = 0.015, 0.15, 0.1, 0.02
"""Largest errors: of a gain, of friction as a share or in N·m, gravity RMS as a share of the largest torque."""
POSES = 300
CREEP = {"span": 1.4, "speeds": [0.2, 0.12]}


@dataclass(frozen=True)
class CreepVerdict:
    """What one arm came to; errors over the joints that gravity shows."""

    names: tuple[str, ...]
    gain: Array
    """Relative errors (n,); NaN where no value is given."""
    scores: dict[str, Array]
    """Errors over standard deviations of each family's values that are given."""
    coulomb: Array
    """Errors (n,) [N·m]."""
    gravity: Array
    """RMS as a share of each joint's largest torque (n,); NaN without gravity."""
    gravity_steps: Array
    """The same by steps at rest; NaN where they were not made or could not be fitted."""
    gravity_nominal: Array
    """The same of a feed-forward by the model's masses, with k = 1, at the joint (n,)."""
    wrong: list[str] = field(default_factory=list)
    unseen: list[str] = field(default_factory=list)
    """Joints without a gain, and the reason given."""

    @property
    def gain_inside(self) -> list[bool]:
        """Whether the 95 % intervals of the gains hold."""
        return (np.abs(self.scores["gain"]) < QUANTILE).tolist()

    @property
    def other_inside(self) -> list[bool]:
        """Whether those of offsets, friction and zeros hold."""
        others = [each for name, each in self.scores.items() if name != "gain"]
        return (np.abs(np.concatenate(others)) < QUANTILE).tolist()


def creep_arm(seed: int) -> ArmFile:
    """An arm of 4 to 7 joints with Damiao drives that suit its weight; its links weigh as drives of their size do."""
    random = np.random.default_rng([seed, 91])
    base, _ = drawn_arm(seed, 4 + seed % 4, upright=seed % 4 == 0)
    n = len(base.joint_names)
    links = [
        {"mass": float(m), "com": random.uniform(-0.06, 0.06, 3).tolist(), "inertia": [0.004 * m + 5e-4] * 3}
        for m in np.linspace(1.4, 0.4, n)
    ]
    rows = [row.model_dump() for row in base.kinematics.joints]
    for row in rows:
        row["a"], row["d"] = 0.6 * row["a"], 0.6 * row["d"]
        low, high = row["lower"], row["upper"]
        row["lower"], row["upper"] = max(low, -2.5), min(high, 2.5)
    content: dict[str, Any] = {
        "name": f"creep{seed}",
        "kinematics": {"gravity": list(base.kinematics.gravity), "joints": rows},
        "link": {"rate": 100, "joints": [_drive(row["name"], place, MODELS[2]) for place, row in enumerate(rows)]},
        "sweep": {"creep": CREEP},
        "sim": {"links": links},
    }
    bare = parse_arm(content, Path(f"creep{seed}.yaml"))
    ends = np.array([[row["lower"], row["upper"]] for row in rows])
    poses = random.uniform(ends[:, 0], ends[:, 1], (300, n))
    largest = np.abs(SimulatedArm(bare, Truth.of(bare)).gravity_torque(poses)).max(axis=0)
    heavy = np.maximum.accumulate(largest[::-1])[::-1]
    drives = []
    for place, (row, torque) in enumerate(zip(rows, heavy, strict=True)):
        model = next((each for each in MODELS if each[2] > 2.5 * torque), MODELS[-1])
        drives.append(_drive(row["name"], place, model))
    content["link"]["joints"] = drives
    content["sim"] |= {"quasi_direct": {}, "step": 0.002}
    return parse_arm(content, Path(f"creep{seed}.yaml"))


def _drive(name: str, place: int, model: tuple[str, float, float]) -> dict[str, Any]:
    kind, rated, most = model
    kp, kd = GAINS[kind]
    drive = {"family": "damiao", "id": place + 1, "reply": place + 17, "model": kind, "kp": kp, "kd": kd}
    return {"name": name, "drive": drive, "rated_torque": rated, "max_torque": most, "max_torque_rate": 10 * most}


def first_of_each(plan: SweepPlan) -> SweepPlan:
    """The plan with one sweep a joint."""
    first = {sweep.joint: sweep for sweep in reversed(plan.sweeps)}
    return plan.model_copy(update={"sweeps": tuple(first[joint] for joint in sorted(first, reverse=True))})


def creep_passes(arm: ArmFile, simulated: SimulatedArm, out: Path, seed: int = 0) -> list[SweepData]:
    """Empty, loaded, empty."""
    plan = plan_creep(arm, seed=seed)
    made = []
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        link.enable()
        for name, mass, used in (
            ("empty", 0.0, plan),
            ("loaded", plan.reference_mass, plan),
            ("again", 0.0, first_of_each(plan)),
        ):
            if mass:
                simulated.attach_mass(mass)
            else:
                simulated.detach_mass()
            made.append(run_sweep(link, arm, out / name, reference_mass=mass, plan=used))
        link.disable()
    return made


def judge_creep(arm: ArmFile, simulated: SimulatedArm, data: list[SweepData], steps: Array | None) -> CreepVerdict:
    """Compare with the truth; `steps` are the errors of gravity by steps at rest, where they were made."""
    fit, described, n = fit_creep(arm, data), gcomp_arm(arm), len(arm.joint_names)
    truth, state = simulated.truth, simulated.plant._imperfections
    gain = warm_gain(simulated, fit)
    lost = fit.reasons
    seen = np.array([(name, "gain") not in lost for name in fit.names])
    off = np.where(seen, fit.value("gain") / gain - 1, np.nan)
    pairs = {
        "gain": gain,
        "offset": truth.offset,
        "coulomb": state.coulomb,
        "load": state.uneven[:, 2],
        "viscous": state.viscous,
        "asymmetry": state.leaning,
        "zero": truth.position_offset,
    }
    scores = dict[str, Array]()
    for family, true in pairs.items():
        counted = seen & np.array([(name, "position_offset") not in lost or family != "zero" for name in fit.names])
        scores[family] = ((fit.value(family) - true) / fit.std(family))[counted]
    friction = np.where(seen, fit.value("coulomb") - state.coulomb, np.nan)
    error, largest = gravity_error(arm, simulated, fit.beta, fit.value("zero"))
    loaded = largest > 0.02 * largest.max()
    given = loaded & fit.found_beta.any()
    share = np.where(given, error / np.maximum(largest, 1e-9), np.nan)
    nominal = nominal_error(arm, simulated, gain) / np.maximum(largest, 1e-9)
    upright = [name for joint, name in enumerate(fit.names) if is_vertical(described, joint)]
    wrong = [f"{name}: gain {each:+.2%}" for name, each in zip(fit.names, off, strict=True) if abs(each) > GAIN]
    bound = np.maximum(COULOMB, COULOMB_SHARE * state.coulomb)
    wrong += [f"{fit.names[j]}: friction {friction[j]:+.3f}" for j in range(n) if abs(friction[j]) > bound[j]]
    wrong += [f"{fit.names[j]}: gravity {share[j]:.2%}" for j in range(n) if share[j] > GRAVITY]
    wrong += [f"{name}: vertical, but a gain is given" for name in upright if (name, "gain") not in lost]
    wrong += [each.text for each in fit.findings]
    return CreepVerdict(
        fit.names, off, scores, friction, share,
        np.full(n, np.nan) if steps is None else np.where(loaded, steps / np.maximum(largest, 1e-9), np.nan),
        np.where(loaded, nominal, np.nan), wrong,
        [f"{joint}: {reason}" for (joint, parameter), reason in lost.items() if parameter == "gain"],
    )  # fmt: skip


def warm_gain(simulated: SimulatedArm, fit: CreepFit) -> Array:
    """True reading per torque (n,) at the temperatures of the fit; drives tell whole kelvins."""
    if not fit.rows.by_temperature:
        return simulated.sensors.gain_at(simulated.time)
    fall, _, heating = simulated.plant._imperfections.warm_constant.T
    rise = fit.rows.warmest - 33.0 + 0.5
    return np.asarray(simulated.truth.gain / (1 - fall * np.nan_to_num(rise) / heating))


def gravity_error(arm: ArmFile, simulated: SimulatedArm, beta: Array, zero: Array) -> tuple[Array, Array]:
    """(RMS of model less true gravity torque (n,), largest true torque (n,)) [N·m] at random true poses."""
    described, simulated_truth = gcomp_arm(arm), simulated.truth
    poses = np.random.default_rng(5).uniform(described.lower, described.upper, (POSES, described.n))
    simulated.detach_mass()
    true = simulated.gravity_torque(poses)
    found = gravity_torque(described, beta, poses - simulated_truth.position_offset + zero)
    return np.sqrt(np.mean((found - true) ** 2, axis=0)), np.abs(true).max(axis=0)


def nominal_error(arm: ArmFile, simulated: SimulatedArm, gain: Array) -> Array:
    """RMS (n,) [N·m] of what the joints get from a feed-forward by exact masses, with k = 1 and zeros as read."""
    described = gcomp_arm(arm)
    links = arm.sim.links
    mass = np.array([each.mass for each in links])
    moments = mass[:, None] * np.array([each.com for each in links])
    beta = base_parameters(described, mass, moments)
    poses = np.random.default_rng(5).uniform(described.lower, described.upper, (POSES, described.n))
    asked = gravity_torque(described, beta, poses - simulated.truth.position_offset)
    made = (asked - simulated.truth.offset) / gain
    true = simulated.gravity_torque(poses)
    return np.asarray(np.sqrt(np.mean((made - true) ** 2, axis=0)))


def steps_error(arm: ArmFile, seed: int, out: Path) -> Array | None:
    """RMS (n,) [N·m] of gravity by the method of steps at rest on the same arm, new; None where it gives up."""
    simulated = SimulatedArm(arm, Truth.draw(arm, seed), seed)
    still = arm.model_copy(
        update={"sweep": arm.sweep.model_copy(update={"hold": "servo", "steps": 5, "max_samples": 30})}
    )
    data: list[SweepData] = []
    try:
        with Link(still, LockStepBus(arm=simulated)) as link:
            link.start()
            link.enable()
            data.append(run_sweep(link, still, out / "steps"))
            assert data[0].plan is not None
            mass = data[0].plan.reference_mass
            simulated.attach_mass(mass)
            data.append(run_sweep(link, still, out / "steps-loaded", reference_mass=mass))
            simulated.detach_mass()
        sensors = fit_sensors(still, data)
        gravity = identify_gravity(still, data, sensors)
    except Exception as error:  # giving up is a result, too
        print(f"    steps at rest: {type(error).__name__}: {error}", flush=True)
        return None
    zero = np.nan_to_num(sensors.value("position_offset"))
    return gravity_error(arm, simulated, gravity.beta, zero)[0]
