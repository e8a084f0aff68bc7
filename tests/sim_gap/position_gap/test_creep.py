"""Friction under which a joint creeps, as MuJoCo's usual solver parameters make it, and friction that holds it."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record, written

from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.model.solver_friction import creep_speeds

pytestmark = pytest.mark.long
FRICTION, GAIN = 0.35, 15.0


def arm(elbow: float, creeps: bool) -> str:
    """The arm with friction of its own at the elbow [N·m]."""
    upper, fore = model_text(kp=GAIN, friction=0.1, creeps=creeps).split('<joint name="elbow"')
    return upper + '<joint name="elbow"' + fore.replace('frictionloss="0.1"', f'frictionloss="{elbow}"')


@pytest.fixture(scope="module")
def creeping(tmp_path_factory) -> Diagnosis:
    """An arm simulated as most are, whose elbow has more friction than its model."""
    real = arm(FRICTION, creeps=True)
    sim = written(tmp_path_factory.mktemp("creeping"), arm(0.1, creeps=True))
    return diagnose(sim, [record(real, 1, 14.0)], [record(real, 2, 9.0)])


def test_friction_of_a_simulated_arm_is_found_at_its_joint_alone(creeping: Diagnosis) -> None:
    """Without creep a quarter of the gap was left, and gains and friction of other joints were blamed."""
    assert creeping.verdict == "explained"
    first = creeping.causes[0]
    assert (first.effect, first.joints) == ("friction.coulomb", ("elbow",))
    assert first.parameters["elbow"]["torque"].value == pytest.approx(FRICTION, rel=0.05)
    assert all(cause.joints == ("elbow",) for cause in creeping.causes if cause.effect.startswith("friction"))


def test_the_written_model_creeps_as_the_arm_does(creeping: Diagnosis) -> None:
    made = mujoco.MjModel.from_xml_string(creeping.internals.export.xml)
    real = mujoco.MjModel.from_xml_string(arm(FRICTION, creeps=True))
    assert creep_speeds(made, [1]) == pytest.approx(creep_speeds(real, [1]), rel=0.2)
    assert creeping.rollout.after[1] < 0.06 * creeping.rollout.before[1]


def test_an_arm_that_rests_is_not_taken_for_one_that_creeps(tmp_path: Path) -> None:
    """The model's solver parameters are no statement about the arm: a joint that rests is not told as a gap."""
    real = arm(FRICTION, creeps=False)
    sim = written(tmp_path, arm(0.1, creeps=True))
    answer = diagnose(sim, [record(real, 1, 24.0)], [record(real, 2, 18.0)])
    assert np.all(answer.internals.search.nominal["creep"] == 0.0)
    assert answer.causes[0].effect == "friction.coulomb"
    assert answer.causes[0].parameters["elbow"]["torque"].value == pytest.approx(FRICTION, rel=0.05)
    assert "friction.creep" not in {cause.effect for cause in answer.causes}
