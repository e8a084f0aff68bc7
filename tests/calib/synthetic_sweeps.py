"""Both passes of a sweep, computed without a bus."""

import numpy as np
from sweep_arms import synthetic_pass

from armlink.arm_file import ArmFile
from calib.dataset import SweepData
from calib.plan.sweep_plan import plan_sweep
from calib.plan.types import SweepPlan
from calib.sweep.step_pass import rough_model
from sim_bus.truth import Truth


def plans(arm: ArmFile, truth: Truth, seed: int) -> tuple[SweepPlan, SweepPlan]:
    """The plans of both passes, as the scout's readings would make them."""
    random, mass, found = np.random.default_rng(seed), 0.0, []
    for _ in range(2):
        scouted = synthetic_pass(arm, truth, plan_sweep(arm, reference_mass=mass), mass, random)
        found.append(plan_sweep(arm, rough_model(arm, scouted.readings), reference_mass=mass))
        mass = found[0].reference_mass
    return found[0], found[1]


def passes(arm: ArmFile, seed: int) -> tuple[Truth, list[SweepData]]:
    truth, random = Truth.draw(arm, seed), np.random.default_rng(seed)
    bare, loaded = plans(arm, truth, seed)
    mass = bare.reference_mass
    return truth, [synthetic_pass(arm, truth, bare, 0.0, random), synthetic_pass(arm, truth, loaded, mass, random)]
