"""Creeps through the link of a small simulated arm: readings on disk, resuming, contacts, verification, records."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from soft_links import soft_arm
from walls import Walls, Watched

from armlink.errors import HostLate, Refused
from armlink.link.link import Link
from calib.arm.sweep_section import sweep_motion
from calib.dataset import load_data
from calib.fit.creep_fit import fit_creep
from calib.motion.mover import Mover, Stalled
from calib.plan.collisions import Collided
from calib.plan.creep_plan import CreepingArm, check_creep_limits, check_creeps, creep_ends, plan_creep
from calib.plan.planned_arm import PlannedArm
from calib.plan.types import Sweep
from calib.sweep.run import run_sweep
from calib.sweep.verify import run_verify, run_weigh
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

arm = cache(soft_arm)


def opened(simulated: SimulatedArm) -> Link:
    return Link(arm(), LockStepBus(arm=simulated))


def test_the_drives_choose_the_motion_and_the_arm_file_overrides_it() -> None:
    assert sweep_motion(arm()) == "creep"
    assert sweep_motion(arm("steps")) == "steps"


@pytest.mark.long
def test_passes_through_the_link_find_constants_that_verification_confirms(tmp_path: Path) -> None:
    simulated = SimulatedArm(arm(), Truth.draw(arm(), 3), 3)
    plan, passes = plan_creep(arm()), []
    with opened(simulated) as link:
        link.start()
        link.enable()
        for name, mass in (("empty", 0.0), ("loaded", plan.reference_mass), ("again", 0.0)):
            simulated.attach_mass(mass, simulated.truth.attachment)
            passes.append(run_sweep(link, arm(), tmp_path / name, reference_mass=mass, plan=plan))
        fit = fit_creep(arm(), passes)
        record = fit.record(arm())
        check = run_verify(link, arm(), fit.gravity.record(arm(), record), record, poses=3)
        simulated.attach_mass(plan.reference_mass / 2, simulated.truth.attachment)
        payload, reached = run_weigh(link, arm(), fit.gravity.record(arm(), record), record, poses=6)
        link.disable()
    assert all(data.creeps and not data.contacts for data in passes)
    np.testing.assert_allclose(fit.value("gain") / simulated.true_sensors.gain, 1.0, atol=0.015)
    assert not fit.findings
    assert check.passed
    assert reached == 6
    assert abs(payload.mass - plan.reference_mass / 2) < 3 * payload.mass_std
    assert payload.mass_std < 0.1 * payload.mass
    line = json.loads((tmp_path / "empty" / "readings.jsonl").read_text().splitlines()[1])
    assert line["speed"] == pytest.approx(0.3, abs=0.02)
    assert len(line["temperature"]) == 2


def test_a_pass_goes_on_after_what_is_on_disk(tmp_path: Path) -> None:
    simulated = SimulatedArm(arm(), Truth.draw(arm(), 4), 4)
    plan = plan_creep(arm())
    half = plan.model_copy(update={"sweeps": plan.sweeps[:1]})
    with opened(simulated) as link:
        link.start()
        link.enable()
        run_sweep(link, arm(), tmp_path / "pass", plan=half)
        before = load_data(tmp_path / "pass").readings
        made = run_sweep(link, arm(), tmp_path / "pass", plan=half, resume=True)
        link.disable()
    assert len(made.readings) == len(before)


def test_a_joint_that_meets_something_is_led_back_and_the_sweep_is_noted(tmp_path: Path) -> None:
    """A stop that the arm file does not know of stands in the way of one creep."""
    simulated = SimulatedArm(arm(), Truth.of(arm()), 5)
    plan = plan_creep(arm())
    sweep = next(each for each in plan.sweeps if each.joint == 1)
    joint = simulated.plant.model.joint("fore").id
    simulated.turn_by_hand("fore", sweep.steps[0])
    clear = {"rest": (plan.sweeps[-1].rest[0], sweep.steps[0])}
    others = [each.model_copy(update=clear) for each in plan.sweeps if each.joint == 0]
    others = [*others, others[0].model_copy(update={"name": "once more"})]
    with opened(simulated) as link:
        link.start()
        link.enable()
        simulated.plant.model.jnt_range[joint][1] = sweep.steps[len(sweep.steps) // 2]
        mixed = plan.model_copy(update={"sweeps": (*others, sweep)})
        data = run_sweep(link, arm(), tmp_path / "pass", plan=mixed)
        link.disable()
    assert [each.reading for each in data.contacts] == [sweep.name]
    assert "fore" in data.contacts[0].reason
    assert {each.joint for each in data.readings} == {0}


def begin_of(sweep: Sweep) -> np.ndarray:
    begin = np.array(sweep.rest)
    begin[sweep.joint] = creep_ends(sweep)[0]
    return begin


def crossing(home: np.ndarray, begin: np.ndarray) -> np.ndarray:
    """A pose from which the middles of the ways to both are far from the way between them."""
    across = np.array([home[1] - begin[1], begin[0] - home[0]])
    return np.asarray((home + begin) / 2 + 0.8 * across / np.linalg.norm(across))


@pytest.mark.parametrize(("straight", "by_home"), [(True, False), (False, True), (False, False)])
def test_after_a_stall_the_way_to_a_creep_goes_around_what_stands_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, straight: bool, by_home: bool
) -> None:
    """The stall leaves the arm elsewhere, among walls; without a clear way the pass ends before anything moves."""
    plan, follow, begun, walls = plan_creep(arm()), Mover.follow, list[int](), list[Walls]()
    home, begin = np.array(plan.scout[0]), begin_of(plan.sweeps[0])
    there = crossing(home, begin)
    ways = [*[(there, begin)] * (not straight), *[(there, home)] * (not by_home)]
    monkeypatch.setattr(PlannedArm, "geometry", property(lambda planned: walls[0] if walls else None))

    def once(mover: Mover, *args: Any) -> Any:
        if walls:
            return follow(mover, *args)
        mover.travel(there, 3.0)
        begun.append(len(watched.kept))
        walls.append(Walls(*ways))
        assert walls[0].free(np.linspace(home, begin, 100)).all()
        mover.link.stop()
        raise HostLate(0.18, 0.1)

    monkeypatch.setattr(Mover, "follow", once)
    plan = plan.model_copy(update={"sweeps": plan.sweeps[:1]})
    with opened(SimulatedArm(arm(), Truth.of(arm()), 5)) as link:
        link.start()
        link.enable()
        watched = Watched(link)
        if straight or by_home:
            assert run_sweep(link, arm(), tmp_path / "pass", plan=plan, on_stall=lambda stall: True).readings
        else:
            expected = f"on the way from its present pose to sweep {plan.sweeps[0].name}"
            with pytest.raises(Collided, match=expected):
                run_sweep(link, arm(), tmp_path / "pass", plan=plan, on_stall=lambda stall: True)
            held = watched.kept[begun[0] :]
            np.testing.assert_allclose(held, [there] * len(held), atol=0.05)
        link.disable()
    moved = np.array(watched.kept[begun[0] :])
    assert walls[0].free(moved).all()


def test_a_joint_that_meets_something_is_not_led_back_through_what_stands_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the way to its creep, so that the way back is none of the plan's."""
    plan, travel, goals, walls = plan_creep(arm()), Mover.travel, list[np.ndarray](), list[Walls]()
    sweep = plan.sweeps[0]
    back = begin_of(sweep)
    there = back + 0.8 * (np.arange(2) == sweep.joint)
    monkeypatch.setattr(PlannedArm, "geometry", property(lambda planned: walls[0] if walls else None))

    def noted(mover: Mover, goal: np.ndarray, acceleration: float) -> None:
        goals.append(goal)
        if len(goals) > 1:
            raise Refused("enough")
        travel(mover, there, acceleration)
        walls.append(Walls((there, back)))
        raise Stalled("fore", 0.0, 0.0, sweep.joint)

    monkeypatch.setattr(Mover, "travel", noted)
    with opened(SimulatedArm(arm(), Truth.of(arm()), 5)) as link:
        link.start()
        link.enable()
        with pytest.raises(Refused, match="enough"):
            run_sweep(link, arm(), tmp_path / "pass", plan=plan)
        link.disable()
    assert [each.reading for each in load_data(tmp_path / "pass").contacts] == [sweep.name]
    assert walls[0].free(np.linspace(there, goals[1], 100)).all()


def test_creeps_are_checked_over_their_whole_way() -> None:
    """It is longer than the bins whose middles a plan lists, by half a bin and a lead at each end."""
    plan = plan_creep(arm())
    sweep, here = plan.sweeps[0], np.array(plan.scout[0])
    end = np.array(sweep.rest)
    end[sweep.joint] = creep_ends(sweep)[1]
    beyond = end.copy()
    beyond[sweep.joint] += 0.1
    assert end[sweep.joint] - sweep.steps[-1] > 0.06
    with pytest.raises(Collided, match=f"in sweep {sweep.name}"):
        check_creeps(arm(), Walls((beyond, beyond)), plan, here)  # type: ignore[arg-type]


EDITED = {
    "faster": ({"speed": 5.0}, "speed is 5 rad/s"),
    "past a stop": ({"steps": (0.0, 3.0, 6.0)}, "last step: fore is at 6 rad"),
    "resting past a stop": ({"rest": (9.0, 0.0)}, "at 9 rad"),
    "fewer joints": ({"rest": (0.0,)}, "rest has 1 values"),
}


@pytest.mark.parametrize("what", EDITED)
def test_a_plan_that_was_edited_is_refused(what: str) -> None:
    plan = plan_creep(arm())
    changed, said = EDITED[what]
    sweeps = tuple(each.model_copy(update=changed) if each.joint == 1 else each for each in plan.sweeps)
    ground = CreepingArm(arm())
    check_creep_limits(ground, arm(), plan)
    with pytest.raises(Refused) as caught:
        check_creep_limits(ground, arm(), plan.model_copy(update={"sweeps": sweeps}))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
