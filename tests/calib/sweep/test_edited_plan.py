"""A plan on disk that was edited before `--resume` is judged like a new one: nothing moves along another."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_arm import along, bench, post

from armlink.arm_file import ArmFile, load_arm
from armlink.errors import Refused
from armlink.link.link import Link
from calib.arm.kinematics import model_arm
from calib.dataset import DataWriter, Manifest, PlanLine
from calib.plan.plan_limits import check_bias, check_limits
from calib.plan.rough_gravity import guess_of_model
from calib.plan.sweep_plan import plan_sweep
from calib.plan.types import SweepPlan
from calib.sweep.run import run_sweep
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

STANDING = 0.05
"""Way within which an enabled joint stands [rad]: it settles in its position loop."""
Edit = Callable[[dict[str, Any]], object]


def small(folder: Path, obstacle: str = "") -> ArmFile:
    """The bench arm, with few poses."""
    bench(folder, obstacle)
    path = folder / "bench.yaml"
    path.write_text(path.read_text() + "sweep: {poses: 1, steps: 5, max_samples: 10}\nsim: {}\n")
    return load_arm(str(path))


def planned(arm: ArmFile) -> SweepPlan:
    model = model_arm(arm)
    return plan_sweep(arm, guess_of_model(model.arm, model.beta))


def resumed(arm: ArmFile, plan: SweepPlan, folder: Path) -> tuple[float, str]:
    """Farthest way of any joint while a data set with this plan is resumed [rad], and why it was refused."""
    simulated = SimulatedArm(arm, Truth.of(arm), 1)
    farthest = 0.0

    class Watched(LockStepBus):
        def put(self, can_id: int, data: bytes) -> None:
            nonlocal farthest
            farthest = max(farthest, float(np.abs(simulated.plant.position - start).max()))
            super().put(can_id, data)

    start = simulated.plant.position.copy()
    with Link(arm, Watched(arm=simulated)) as link:
        link.start()
        link.enable()
        installed = [link.read_calibration(joint) for joint in range(link.n)]
        with DataWriter(folder, Manifest.of(arm, 0.0, installed)) as writer:
            writer.append(PlanLine(plan=plan, resolution=(0.0,) * link.n))
        said = ""
        try:
            run_sweep(link, arm, folder, resume=True)
        except Refused as refused:
            said = str(refused)
        link.disable()
    return farthest, said


def test_a_plan_that_leads_through_a_post_is_refused_before_anything_moves(tmp_path: Path) -> None:
    """The post stood there when the arm was planned; the edited plan goes through it, within all limits."""
    arm = small(tmp_path)
    plan = planned(arm)
    sweep = next(each for each in plan.sweeps if each.joint == 0)
    middle = (sweep.steps[0] + sweep.steps[-1]) / 2
    arm = small(tmp_path, post(*along(middle, sweep.rest[1], 0.8), half=0.02))
    farthest, refused = resumed(arm, plan, tmp_path / "data")
    assert "post would touch" in refused
    assert farthest < STANDING


def _set(**values: Any) -> Edit:
    return lambda plan: plan["sweeps"][0].update(values)


EDITS: dict[str, tuple[Edit, str]] = {
    "a step past a stop": (lambda p: p["sweeps"][0]["steps"].__setitem__(-1, 3.0), "last step: elbow is at 3 rad"),
    "a scout pose past a stop": (lambda p: p["scout"][0].__setitem__(0, -2.0), "scout pose 1: shoulder is at -2 rad"),
    "no scout pose": (lambda p: p.update(scout=[]), "no scout pose"),
    "a resting joint in the middle": (lambda p: p["sweeps"][0]["rest"].__setitem__(0, 0.3), "shoulder is at 0.3 rad"),
    "more than its torque": (lambda p: p["sweeps"][0].update(bias=[300.0, 0.0]), "pressed with 300 N·m"),
    "away from its stop": (
        lambda p: p["sweeps"][0].update(bias=[-x for x in p["sweeps"][0]["bias"]]),
        "away from the stop",
    ),
    "no bias torque": (_set(bias=None), "`bias` is missing"),
    "faster than it may": (_set(acceleration=50.0), "acceleration is 50 rad/s²"),
    "faster on the way": (lambda p: p.update(travel_acceleration=40.0), "travel_acceleration is 40 rad/s²"),
    "another joint": (_set(joint=7), "joint is 7, expected 0 to 1"),
    "fewer joints": (_set(rest=[0.0]), "rest has 1 values"),
    "steps that fall": (lambda p: p["sweeps"][0]["steps"].reverse(), "steps do not increase"),
    "a joint that hangs loose": (
        _set(stops=[0, 0], servo=[False, False]),
        "neither on a stop nor by its position loop",
    ),
    "twice the same sweep": (lambda p: p["sweeps"].append(p["sweeps"][0]), "two sweeps are called"),
    "no accuracy": (lambda p: p.update(standard_error=0.0), "standard_error is 0"),
    "a creep": (_set(speed=0.2), "is a creep sweep"),
}


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> tuple[ArmFile, str]:
    arm = small(tmp_path_factory.mktemp("bare"))
    return arm, planned(arm).model_dump_json()


@pytest.mark.parametrize("what", EDITS)
def test_a_plan_beyond_the_limits_is_refused_in_one_line(what: str, bare: tuple[ArmFile, str]) -> None:
    arm, content = bare[0], json.loads(bare[1])
    edit, said = EDITS[what]
    edit(content)
    plan = SweepPlan.model_validate(content)
    with pytest.raises(Refused) as caught:
        check_bias(arm, plan), check_limits(arm, plan)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("what", ["a step past a stop", "more than its torque", "no bias torque"])
def test_nothing_moves_along_a_plan_beyond_the_limits(what: str, bare: tuple[ArmFile, str], tmp_path: Path) -> None:
    arm, content = bare[0], json.loads(bare[1])
    edit, said = EDITS[what]
    edit(content)
    farthest, refused = resumed(arm, SweepPlan.model_validate(content), tmp_path / "data")
    assert said in refused
    assert "\n" not in refused
    assert farthest < STANDING


@pytest.mark.long
def test_the_planner_keeps_to_the_limits_that_it_is_judged_by(tmp_path: Path) -> None:
    arm = small(tmp_path)
    check_limits(arm, plan_sweep(arm))
    check_limits(arm, planned(arm))
    farthest, refused = resumed(arm, planned(arm), tmp_path / "data")
    assert not refused
    assert farthest > 1.0
