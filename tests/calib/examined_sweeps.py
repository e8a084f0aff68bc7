"""Sweeps of a small arm, drawn from MuJoCo's gravity, with a change put into the readings of one joint."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from sweep_arms import synthetic_pass

from armlink.arm_file import ArmFile
from calib.dataset import SweepData
from calib.fit.sensor_fit import SensorFit
from calib.motion.static_reading import StaticReading
from calib.plan.sweep_plan import plan_sweep
from calib.sweep.step_pass import rough_model
from sim_bus.truth import Truth

JOINT = 1


def swept(arm: ArmFile, truth: Truth, seed: int) -> list[SweepData]:
    """Both passes, drawn from MuJoCo's gravity."""
    random, mass, found = np.random.default_rng(seed), 0.0, []
    for _ in range(2):
        scouted = synthetic_pass(arm, truth, plan_sweep(arm, reference_mass=mass), mass, random)
        plan = plan_sweep(arm, rough_model(arm, scouted.readings), reference_mass=mass)
        found.append(synthetic_pass(arm, truth, plan, mass, random))
        mass = found[0].plan.reference_mass
    return found


def bent(data: list[SweepData], change: Callable[[StaticReading, np.ndarray, np.ndarray], None]) -> list[SweepData]:
    """The same data with position and torque of each reading changed in place."""
    passes = []
    for each in data:
        readings = []
        for reading in each.readings:
            position, torque = reading.position.copy(), reading.torque.copy()
            change(reading, position, torque)
            readings.append(replace(reading, position=position, torque=torque))
        passes.append(replace(each, readings=tuple(readings)))
    return passes


def rated(arm: ArmFile) -> float:
    return arm.require_link().joints[JOINT].rated_torque


def z_scores(fit: SensorFit, truth: Truth, parameter: str) -> np.ndarray:
    return (fit.value(parameter) - getattr(truth, parameter)) / fit.std(parameter)
