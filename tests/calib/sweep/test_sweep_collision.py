"""Planning around what stands in the way: an MJCF model with bodies that touch, and what a person is told."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from bench_arm import along, bench, post

from armlink.arm_file import ArmFile, load_arm
from armlink.cli import run
from calib.plan.collisions import DEPTH, Collided, Geometry, check_plan, clear_way, ways_along
from calib.plan.planned_arm import PlannedArm
from calib.plan.sweep_plan import plan_sweep
from calib.plan.types import APPROACH
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
    sweeps = [way for where, *way in ways_along(plan) if "sweep" in where]
    places = [*map(np.array, plan.scout), *(pose for way in sweeps for pose in np.linspace(*way, 16))]
    for pose in (pose for way in pairwise(map(np.array, plan.scout)) for pose in np.linspace(*way, 16)):
        arm = bench(tmp_path, post(*along(*pose, 0.8), half=0.02))
        if Geometry(arm).free(np.array(places)).all():
            with pytest.raises(
                Collided,
                match=r"touch \w+ on the way to pose \d of the rough gravity model, \d+\.\d mm deep, at -?\d",
            ):
                check_plan(arm, plan)
            scouted = np.array(plan_sweep(arm).scout)
            assert all(PlannedArm(arm).is_clear(*way) for way in pairwise(scouted))  # a plan of this arm goes elsewhere
            return
    pytest.fail("no way of this plan is clear of all its places")


def test_the_way_from_the_present_pose_is_checked_as_the_plan_is(tmp_path: Path) -> None:
    arm = bench(tmp_path, post(*along(0.5, 0.0, 0.8), half=0.02))
    plan, planned = plan_sweep(arm), PlannedArm(arm)
    first = np.array(plan.scout[0])
    poses = planned.free_poses(10, np.random.default_rng(2))
    blocked = next(pose for pose in poses if not planned.is_clear(pose, first))
    clear = next(pose for pose in poses if planned.is_clear(pose, first))
    assert int(check_plan(arm, plan, clear).split()[3]) > int(check_plan(arm, plan).split()[3])
    with pytest.raises(Collided, match=r"touch \w+ on the way from its present pose to the first pose, .* mm deep, at"):
        check_plan(arm, plan, blocked)
    place, *way = next(ways_along(plan, blocked))
    assert place == "on the way from its present pose to the first pose"
    np.testing.assert_array_equal(way, [blocked, first])


BEGIN, END = np.array([-1.2, 0.0]), np.array([1.2, 0.0])


def test_a_post_that_is_narrower_than_the_steps_of_a_long_way_is_found(tmp_path: Path) -> None:
    """At none of 16 poses of equal distance does the arm touch it: its tip moves 12 cm from one to the next."""
    arm = bench(tmp_path, post(*along(0.0, 0.0, 0.95), half=0.005))
    planned, geometry = PlannedArm(arm), Geometry(arm)
    assert planned.free(np.linspace(BEGIN, END, 16)).all()
    assert not planned.is_clear(BEGIN, END)
    with pytest.raises(Collided, match="post would touch fore there"):
        clear_way(arm, geometry, [[BEGIN, END]], "there")
    assert planned.is_clear(BEGIN, BEGIN / 15)


def test_an_arm_that_touches_where_it_stands_may_leave_and_not_go_through(tmp_path: Path) -> None:
    arm = bench(tmp_path, post(*along(0.0, 0.0, 0.8), half=0.02))
    geometry, standing = Geometry(arm), np.array([0.06, 0.0])
    assert geometry.contacts(standing)
    clear_way(arm, geometry, [[standing, END]], "there")
    with pytest.raises(Collided, match="post would touch fore there"):
        clear_way(arm, geometry, [[standing, BEGIN]], "there")
    assert not PlannedArm(arm).is_clear(standing, END)  # for plans the first pose counts, too


VERTICES = " ".join(f"{each:.4f}" for each in np.random.default_rng(0).normal(0.0, 0.06, 36))
SHAPES = ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")


def drawn_arm(folder: Path, random: np.random.Generator) -> ArmFile:
    """Four joints with any axes and offsets, two of them in one body; shapes of every kind, some on a bracket; boxes,
    uneven ground and a plane around. One pair of bodies is excluded."""

    def vector(scale: float) -> str:
        return " ".join(f"{each:.4f}" for each in random.normal(0.0, scale, 3))

    def shape() -> str:
        kind = str(random.choice(SHAPES))
        size = 'mesh="stone"' if kind == "mesh" else f'size="{" ".join(map(str, random.uniform(0.01, 0.06, 3)))}"'
        return f'<geom type="{kind}" {size} pos="{vector(0.05)}" euler="{vector(1.0)}" mass="1"/>'

    def joint(name: str) -> str:
        return f'<joint name="{name}" axis="{vector(1.0)}" pos="{vector(0.03)}" range="-2 2"/>'

    bracket = f'<body name="bracket" pos="{vector(0.1)}" euler="{vector(1.0)}">{shape()}</body>'
    hand = f'<body name="hand" pos="{vector(0.3)}">{joint("j4")}{shape()}</body>'
    fore = (
        f'<body name="fore" pos="{vector(0.4)}" euler="{vector(1.0)}">{joint("j2")}{joint("j3")}{shape()}{hand}</body>'
    )
    upper = f'<body name="upper" pos="0 0 0.3">{joint("j1")}{shape()}{bracket}{fore}</body>'
    around = "".join(
        f'<geom type="box" size="0.005 0.005 0.3" pos="{vector(0.6)}" euler="{vector(1.0)}"/>' for _ in range(8)
    )
    (folder / "drawn.xml").write_text(
        f"""<mujoco><compiler angle="radian"/><asset><mesh name="stone" vertex="{VERTICES}"/>
        <hfield name="ground" nrow="3" ncol="3" size="1 1 0.2 0.1" elevation="0 1 0 0 0 1 1 0 0"/></asset>
        <worldbody>{around}<geom type="plane" size="2 2 1" pos="0 0 -0.8"/>
        <geom type="hfield" hfield="ground" pos="0 0 -0.9"/>{upper}</worldbody>
        <contact><exclude body1="upper" body2="hand"/></contact></mujoco>"""
    )
    joints = "".join(f"\n    - {{name: j{k}, node: {k}, rated_torque: 20.0, max_torque: 30.0}}" for k in (1, 2, 3, 4))
    text = f"name: drawn\nkinematics: {{model: drawn.xml, tip: hand}}\nlink:\n  joints:{joints}\n"
    (folder / "drawn.yaml").write_text(text)
    return load_arm(str(folder / "drawn.yaml"))


def test_a_way_that_is_called_clear_is_clear_at_random_poses_in_between(tmp_path: Path) -> None:
    """By MuJoCo's contacts, whose distances the choice of poses does not use."""
    random, clear = np.random.default_rng(1), 0
    for _ in range(8):
        geometry = Geometry(drawn_arm(tmp_path, random))
        begins = random.uniform(-2, 2, (15, 4))
        for begin, end in zip(begins, begins + random.normal(0.0, 1.5, (15, 4)), strict=True):
            if any(touching for _, touching in geometry.way(begin, end)):
                continue
            clear += 1
            for share in random.uniform(size=500):
                touching = geometry.contacts(begin + share * (end - begin))
                assert not touching or touching[0].depth < 2 * DEPTH
    assert clear > 50


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


def test_the_approach_to_the_last_step_is_checked(tmp_path: Path) -> None:
    """A step is approached from before it, so a sweep goes on beyond its last step to come back to it."""
    plan = plan_sweep(bench(tmp_path))
    found = 0
    for sweep in plan.sweeps:
        steps = np.repeat(np.array(sweep.rest)[None], 30, axis=0)
        steps[:, sweep.joint] = np.linspace(sweep.steps[0], sweep.steps[-1], 30)
        beyond = steps[-1:].copy()
        beyond[:, sweep.joint] += APPROACH
        for ahead in np.linspace(0.0, 0.3, 61):
            place = beyond[0].copy()
            place[sweep.joint] += ahead
            arm = bench(tmp_path, post(*along(*place, 0.8), half=0.005))
            if Geometry(arm).free(steps).all() and not Geometry(arm).free(beyond).all():
                found += 1
                with pytest.raises(Collided, match="touch"):
                    check_plan(arm, plan)
                break
    assert found
