"""Hard cases for a sweep, one at a time, through the real runner on the simulated arm.

`make(case, arm)` gives the arm and its simulation; `sweep_case` sweeps it; `judge` says whether the fit names the
joint or else keeps the truth within its intervals.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from drawn_arms import BUNDLED, asked_arm, sweep
from rank_test import undetermined
from sweep_arms import random_arm, with_section

from armlink.arm_file import ArmFile
from calib.arm.kinematics import DriveLimits
from calib.dataset import SweepData
from calib.fit.sensor_fit import SensorFit, fit_sensors
from calib.plan.types import SweepPlan
from calib.sweep import step_pass as runner
from sim_bus.sim_section import EffectEntry
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

CASES = ("sound", "range", "slip", "spring", "hysteresis", "encoder", "vertical")
JOINT = 1
"""The joint that has the trouble; at `vertical` it is the first."""
RANGE, SPRING, HYSTERESIS = np.pi / 3, 0.04, 0.03
"""Range [rad], stiffness [rated torques/rad], half width of the play [rated torques]."""
BITS = range(1, 11)
"""Stuck bits of the encoder, one after the other with the seed."""
WEAK = 0.8
"""Share of the gravity torque at which the slipping joint is pressed."""
SENSOR = ("gain", "offset", "position_gain")


@dataclass
class Case:
    """One arm with one trouble, swept."""

    name: str
    arm: ArmFile
    simulated: SimulatedArm
    data: list[SweepData]
    slips: int
    """How often a resting joint was found off its stop."""


@dataclass(frozen=True)
class Outcome:
    """What the fit made of it."""

    fit: SensorFit
    scores: np.ndarray
    """Errors of the values of joints that are not named, in standard deviations."""
    named: tuple[str, ...]
    """Joints at which the fit says that the model does not hold."""
    wrong: tuple[str, ...]


def hard_arm(case: str, seed: int, n: int = 3, **section: Any) -> tuple[ArmFile, SimulatedArm]:
    """A random arm with the case's trouble, and its simulation."""
    arm = random_arm(seed, n, vertical=case == "vertical")
    arm = with_section(arm, **section) if section else arm
    return troubled(case, arm, Truth.draw(arm, seed), seed)


def asked_hard_arm(case: str, which: str) -> tuple[ArmFile, SimulatedArm]:
    """Likewise one of the arms that the sweeps' bounds are asked on."""
    arm, truth = asked_arm(which, upright=case == "vertical" or None)
    return troubled(case, arm, truth, 1 if which in BUNDLED else int(which))


def troubled(case: str, arm: ArmFile, truth: Truth, seed: int) -> tuple[ArmFile, SimulatedArm]:
    """The arm with the case's trouble, and its simulation."""
    if case == "range":
        arm = _short(arm)
    rated = float(DriveLimits.of(arm).rated[JOINT])
    simulated = SimulatedArm(arm, truth, seed)
    if case == "spring":
        simulated.set_effects([*simulated.effects, _effect(arm, "transmission.spring", stiffness=SPRING * rated)])
    if case == "hysteresis":
        simulated.set_effects([*simulated.effects, _effect(arm, "torque.hysteresis", width=HYSTERESIS * rated)])
    if case == "encoder":
        stick(simulated, BITS[seed % len(BITS)])
    return arm, simulated


def sweep_case(case: str, arm: ArmFile, simulated: SimulatedArm, out: Path, *, loaded: bool = True) -> Case:
    """The pass without and, if asked for, the pass with the recommended mass."""
    with _weakened(simulated, case == "slip") as slips:
        data = sweep(simulated, out, loaded=loaded)
    return Case(case, arm, simulated, data, slips())


def judge(case: Case) -> Outcome:
    """Fit; wrong is a value off by more than four standard deviations of a joint not named, or a name invented."""
    fit, truth = fit_sensors(case.arm, case.data), case.simulated.true_sensors
    trusted = np.array([name not in fit.doubtful for name in fit.names])
    scores = np.concatenate([((fit.value(p) - getattr(truth, p)) / fit.std(p))[trusted] for p in SENSOR])
    scores = np.abs(scores[np.isfinite(scores)])
    wrong = []
    innocent = set(fit.doubtful) - {case.arm.joint_names[JOINT]}
    if innocent or (fit.doubtful and case.name in ("sound", "range", "slip", "vertical")):
        wrong.append(f"{' '.join(fit.doubtful)} named")
    if scores.max(initial=0.0) > 4:
        wrong.append(f"off by {scores.max():.1f} standard deviations, and that joint is not named")
    if case.name == "slip" and not case.slips:
        wrong.append("nothing slipped")
    lost, said = undetermined(case.arm, case.data), {key for key in fit.reasons if key[1] in SENSOR}
    hopeless = {tuple(reversed(name.rstrip("]").split("["))) for name in fit.fit.hopeless}
    if len(case.data) > 1 and (lost - said or said - lost - hopeless):
        wrong.append(f"lost by rank {sorted(lost)}, by the fit {sorted(said)}")
    return Outcome(fit, scores, fit.doubtful, tuple(wrong))


def _short(arm: ArmFile) -> ArmFile:
    rows = list(arm.kinematics.joints)
    rows[JOINT] = rows[JOINT].model_copy(update={"upper": rows[JOINT].lower + RANGE})
    return arm.model_copy(update={"kinematics": arm.kinematics.model_copy(update={"joints": tuple(rows)})})


def _effect(arm: ArmFile, name: str, **values: float) -> EffectEntry:
    return EffectEntry(effect=name, joint=arm.joint_names[JOINT], **values)


def stick(simulated: SimulatedArm, bit: int) -> None:
    """One bit of a position reading is always 0."""
    sensors, whole = simulated.sensors, simulated.sensors.position_counts

    def stuck(angle: np.ndarray) -> np.ndarray:
        counts = whole(angle)
        counts[JOINT] = float(int(counts[JOINT]) & ~(1 << bit))
        return counts

    sensors.position_counts = stuck  # type: ignore[method-assign]


@contextmanager
def _weakened(simulated: SimulatedArm, wanted: bool) -> Iterator[Callable[[], int]]:
    """The plan presses one resting joint too weakly for gravity; gives how often a joint was pressed again."""
    plans, more, slips = runner._final_plan, runner.StepPass._firmer, []

    def weak(*given: Any) -> SweepPlan:
        plan = plans(*given)
        pulls = {
            (place, joint): _against(simulated, plan, place, joint) / limit
            for place, sweep in enumerate(plan.sweeps)
            for joint, limit in enumerate(DriveLimits.of(simulated.arm).rated)
            if sweep.stops[joint] and not sweep.servo[joint]
        }
        (place, joint), pull = max(pulls.items(), key=lambda item: item[1])
        assert pull > 0.12, "no resting joint is pulled off its stop"
        sweep = plan.sweeps[place]
        bias = list(sweep.bias or ())
        bias[joint] = WEAK * sweep.stops[joint] * _against(simulated, plan, place, joint)
        sweeps = [*plan.sweeps]
        sweeps[place] = sweep.model_copy(update={"bias": tuple(bias)})
        return plan.model_copy(update={"sweeps": tuple(sweeps)})

    def counted(*given: Any) -> np.ndarray:
        slips.append(given)
        return more(*given)

    with (
        patch.object(runner.StepPass, "_firmer", counted),
        patch.object(runner, "_final_plan", weak if wanted else plans),
    ):
        yield lambda: len(slips)


def _against(simulated: SimulatedArm, plan: SweepPlan, place: int, joint: int) -> float:
    """Largest torque that pulls a resting joint off its stop during a sweep [N·m]."""
    sweep = plan.sweeps[place]
    poses = np.tile(sweep.rest, (len(sweep.steps), 1))
    poses[:, sweep.joint] = sweep.steps
    return float((sweep.stops[joint] * simulated.gravity_torque(poses)[:, joint]).max())
