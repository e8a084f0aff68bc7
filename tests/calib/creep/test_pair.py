"""Both arms of a pair: the one that is parked counts as an obstacle, wherever its model comes from."""

from pathlib import Path

import numpy as np
import pytest

from armlink.arm_file import ArmFile, load_arm
from armlink.errors import BadInput
from armlink.link.link import Link
from calib.arm.sweep_section import CreepSection, ParkedArm, SweepSection
from calib.plan.collisions import Collided, Geometry
from calib.plan.creep_plan import check_creeps, plan_creep
from calib.sweep.run import run_sweep
from sim_bus.arms import __file__ as bundled
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

QUICK = CreepSection(span=1.2, bin=0.12, speeds=(0.2, 0.1))
OTHER = Path(bundled).with_name("openarm.xml")
RAISED = {"openarm_right_joint4": 1.5}
"""Pose of the other arm: its forearm is lifted."""
DOWN = np.zeros(7)


def arm(*beside: ParkedArm) -> ArmFile:
    return load_arm("openarm").model_copy(update={"sweep": SweepSection(creep=QUICK, beside=beside)})


NEAR, FAR = (0.3, -0.2, 0.0), (-2.0, 0.0, 0.0)
"""Places of the other arm's model in this one's frame [m]."""


def other(at: tuple[float, float, float]) -> ParkedArm:
    return ParkedArm(model=OTHER, at=at, pose=RAISED)


def test_a_sweep_that_would_hit_the_parked_arm_is_refused_by_name_before_anything_moves(tmp_path: Path) -> None:
    alone, pair = arm(), arm(other(NEAR))
    plan, simulated = plan_creep(alone), SimulatedArm(alone, Truth.of(alone))
    check_creeps(alone, Geometry(alone), plan, np.array(plan.scout[0]))
    with Link(pair, LockStepBus(arm=simulated)) as link:
        link.start()
        link.enable()
        before = simulated.plant.position.copy()
        with pytest.raises(Collided, match=r"would touch parked openarm_right_\w+ .*mm deep"):
            run_sweep(link, pair, tmp_path / "empty", plan=plan)
        np.testing.assert_allclose(simulated.plant.position, before, atol=0.02)
        link.disable()


def test_the_plan_goes_round_the_parked_arm() -> None:
    pair = arm(other(NEAR))
    geometry, plan = Geometry(pair), plan_creep(pair)
    check_creeps(pair, geometry, plan, np.array(plan.scout[0]))


def test_place_turn_and_pose_of_the_parked_arm_count() -> None:
    far = Geometry(arm(other(FAR)))
    turned = Geometry(arm(ParkedArm(model=OTHER, at=FAR, turned=(0.0, 0.0, np.pi / 2), pose=RAISED)))
    hand = "parked openarm_right_link5"
    assert not any(geometry.contacts(DOWN) for geometry in (far, turned))
    reach = far.data.body(hand).xpos - FAR
    np.testing.assert_allclose(turned.data.body(hand).xpos - FAR, [-reach[1], reach[0], reach[2]], atol=1e-9)
    lowered = Geometry(arm(ParkedArm(model=OTHER, at=FAR)))
    lowered.contacts(DOWN)
    assert lowered.data.body(hand).xpos[2] < far.data.body(hand).xpos[2]


def test_in_a_model_of_both_arms_the_other_joints_are_parked_where_the_arm_file_says(tmp_path: Path) -> None:
    both = load_arm("openarm")
    text = OTHER.read_text()
    begin, end = text.index('<body name="openarm_right_base_link"'), text.index("</worldbody>")
    left = text[begin:end].replace("openarm_right", "openarm_left").replace('pos="0 -0.031 0"', 'pos="0.3 -0.231 0"', 1)
    (tmp_path / "pair.xml").write_text(text[:end] + left + text[end:])
    kinematics = both.kinematics.model_copy(update={"model": tmp_path / "pair.xml"})
    parked = ParkedArm(pose={"openarm_left_joint4": 1.5})
    pair = both.model_copy(update={"kinematics": kinematics, "sweep": SweepSection(creep=QUICK, beside=(parked,))})
    plan = plan_creep(arm())
    with pytest.raises(Collided, match="openarm_left_"):
        check_creeps(pair, Geometry(pair), plan, np.array(plan.scout[0]))
    wrong = pair.model_copy(update={"sweep": SweepSection(beside=(ParkedArm(pose={"openarm_right_joint4": 1.0}),))})
    with pytest.raises(BadInput, match="'openarm_right_joint4' is moved by a drive of this arm"):
        Geometry(wrong)


def test_a_joint_that_the_parked_arm_does_not_have_and_an_arm_without_geometry_are_named() -> None:
    with pytest.raises(BadInput, match="joint 'elbow' is not in"):
        Geometry(arm(ParkedArm(model=OTHER, pose={"elbow": 1.0})))
    rows = load_arm("sarcos").model_copy(update={"sweep": SweepSection(beside=(ParkedArm(),))})
    with pytest.raises(BadInput, match=r"sweep\.beside: checking for collisions needs geometry"):
        plan_creep(rows)
