"""Planning around what stands in the way: an MJCF model with bodies that touch, and what a person is told."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from bench_arm import along, bench, post

from armlink.cli import run
from calib.plan.collisions import POINTS, Collided, Geometry, check_plan, poses_along
from calib.plan.planned_arm import PlannedArm
from calib.plan.sweep_plan import plan_sweep
from calib.sweep.verify import verify_poses


def test_a_clear_workspace_is_said_to_be_clear(tmp_path: Path) -> None:
    arm = bench(tmp_path)
    assert check_plan(arm, plan_sweep(arm)).startswith("no collision at ")


def test_a_stop_at_which_the_arm_touches_is_not_leant_on(tmp_path: Path) -> None:
    """The post stands where the forearm is when the elbow rests at its upper stop and the shoulder is low."""
    arm = bench(tmp_path, post(*along(1.1, 1.4, 0.9), half=0.03))
    plan, free = plan_sweep(arm), bench(tmp_path)
    shoulder = [sweep for sweep in plan.sweeps if sweep.joint == 0]
    assert {sweep.stops[1] for sweep in shoulder} == {-1}
    assert {sweep.stops[1] for sweep in plan_sweep(free).sweeps if sweep.joint == 0} == {-1, 1}


@pytest.mark.parametrize("height", [-0.02, 0.13])
def test_a_body_in_the_middle_of_every_sweep_refuses_the_plan(tmp_path: Path, height: float) -> None:
    """Even where it stands between the steps of a sweep."""
    arm = bench(tmp_path, post(0.3, height))
    with pytest.raises(Collided, match="in every combination of stops two bodies touch, for example post and upper"):
        plan_sweep(arm)


def test_a_way_that_touches_is_refused_with_bodies_and_pose(tmp_path: Path) -> None:
    """No place of the plan touches the post, only the way from one to the next."""
    plan = plan_sweep(bench(tmp_path))
    places = [np.array(pose) for pose in plan.scout] + [pose for where, pose in poses_along(plan) if "sweep" in where]
    for pose in (pose for where, pose in poses_along(plan) if "rough gravity model" in where):
        arm = bench(tmp_path, post(*along(*pose, 0.8), half=0.02))
        if Geometry(arm).free(np.array(places)).all():
            with pytest.raises(
                Collided,
                match=r"touch \w+ on the way to pose \d of the rough gravity model, \d+\.\d mm deep, at -?\d",
            ):
                check_plan(arm, plan)
            scouted = [pose for where, pose in poses_along(plan_sweep(arm)) if "rough gravity model" in where]
            assert Geometry(arm).free(np.array(scouted)).all()  # a plan of this arm goes by other poses
            return
    pytest.fail("no way of this plan is clear of all its places")


def test_the_way_from_the_present_pose_is_checked_as_the_plan_is(tmp_path: Path) -> None:
    arm = bench(tmp_path, post(*along(0.5, 0.0, 0.8), half=0.02))
    plan, planned = plan_sweep(arm), PlannedArm(arm)
    first = np.array(plan.scout[0])
    poses = planned.free_poses(10, np.random.default_rng(2))
    blocked = next(pose for pose in poses if not planned.is_clear(pose, first))
    clear = next(pose for pose in poses if planned.is_clear(pose, first))
    assert int(check_plan(arm, plan, clear).split()[3]) == int(check_plan(arm, plan).split()[3]) + POINTS - 1
    with pytest.raises(Collided, match=r"touch \w+ on the way from its present pose to the first pose, .* mm deep, at"):
        check_plan(arm, plan, blocked)
    place, pose = next(poses_along(plan, blocked))
    assert place == "on the way from its present pose to the first pose"
    np.testing.assert_allclose(pose, blocked + (first - blocked) / POINTS)


def test_verification_goes_around_what_stands_in_the_way(tmp_path: Path) -> None:
    arm = bench(tmp_path, post(0.3, 0.3))
    planned, begin = PlannedArm(arm), np.zeros(2)
    assert planned.free(planned.drawn_poses(300, np.random.default_rng(0))).mean() < 0.95
    poses = verify_poses(planned, 20, 1, begin)
    assert len(poses) == 20
    for here, pose in pairwise([begin, *poses]):
        assert planned.is_clear(here, pose)


def test_the_command_says_it_in_one_line_and_exits_with_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench(tmp_path, post(0.3, -0.02))
    assert run(["sweep", str(tmp_path / "bench.yaml"), "--plan"]) == 1
    error = capsys.readouterr().err
    assert "for example post and upper" in error
    assert error.strip().count("\n") == 0


def test_the_plan_of_a_model_tells_bias_torques_and_what_was_checked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench(tmp_path)
    picture = tmp_path / "plan.html"
    assert run(["sweep", str(tmp_path / "bench.yaml"), "--plan", "--picture", str(picture), "--json", "-"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert all(np.abs(sweep["bias"]).max() > 0 for sweep in plan["sweeps"])
    assert plan["collisions"].startswith("no collision")
    assert "plotly" in picture.read_text(encoding="utf-8")
