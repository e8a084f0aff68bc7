"""The model with the effects added: MuJoCo then gives the torque that the recording shows."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from wrong_arms import THREE, Wrong, model, motion, record

from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.better_model.export import add_motors, write_model
from sim_gap.model.load import load_model, tendons_of

CASES = {
    "payload": Wrong(payload=0.8),
    "moved mass": Wrong(moved={1: (0.02, 0.02, 0.0)}),
    "rotor and friction": Wrong(rotor=np.array([0.8, 0.0, 0.0]), viscous=np.array([0.0, 1.0, 0.0])),
    "tilt": Wrong(tilt=(0.03, 0.02)),
    "spring": Wrong(spring=np.array([0.0, 2.0, 0.0])),
    "position offset": Wrong(position_offset=np.array([0.0, 0.12, 0.0])),
}


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_the_written_model_has_no_gap_any_more(tmp_path, name):
    (tmp_path / "arm.xml").write_text(THREE)
    nominal = load_model(tmp_path / "arm.xml")
    train, other = (
        record(nominal.mujoco_model, CASES[name], seed=s, seconds=30, noise=0.002, channels=("tau_motor",))
        for s in (1, 2)
    )
    answer = diagnose(tmp_path / "arm.xml", [train], [other])
    earlier = tmp_path / "closed_effects.py"
    earlier.write_text("# of an earlier model")
    assert write_model(nominal, answer.internals.estimate, tmp_path / "closed.xml") == []
    assert not earlier.exists()
    closed = diagnose(tmp_path / "closed.xml", [other], [train])
    assert closed.verdict == "no_gap"
    assert np.all(closed.heldout_before < 0.1 * answer.heldout_before.max() + 0.02)
    assert answer.rollout.after.max() < 0.2 * answer.rollout.before.max()


@pytest.mark.parametrize("friction", ["", 'frictionloss="0.3"'])
def test_friction_of_the_written_model_creeps_as_the_nominal_models(tmp_path, friction):
    """Rows in which a joint creeps are not judged: with more of them a second diagnosis would judge other rows."""
    (tmp_path / "arm.xml").write_text(THREE.replace("<joint ", f"<joint {friction} "))
    nominal = load_model(tmp_path / "arm.xml")
    wrong = Wrong(coulomb=np.array([1.0, 0.8, 0.6]))
    made = record(nominal.mujoco_model, wrong, seconds=20, rate=50.0, noise=0.002, channels=("tau_motor",))
    answer = diagnose(tmp_path / "arm.xml", [made])
    write_model(nominal, answer.internals.estimate, tmp_path / "closed.xml")
    closed = load_model(tmp_path / "closed.xml").arm
    np.testing.assert_allclose(closed.frictionloss, wrong.coulomb, rtol=0.01)
    np.testing.assert_allclose(closed.creep, nominal.arm.creep, rtol=0.05, atol=1e-3)


@pytest.mark.long
def test_a_spring_is_read_by_a_sensor_on_the_link(tmp_path):
    """It acts beside motor and sensor: the model that has it leaves no gap in `tau`, rest and all."""
    text = THREE.replace('<joint name="joint_2"', '<joint name="joint_2" stiffness="2" springref="{}"')
    (tmp_path / "real.xml").write_text(text.format("30"))
    (tmp_path / "arm.xml").write_text(THREE)
    real = load_model(tmp_path / "real.xml")
    train, other = (_sprung(real.arm.stiffness, real.arm.rest, seed) for seed in (1, 2))
    assert diagnose(tmp_path / "real.xml", [train], [other]).verdict == "no_gap"
    answer = diagnose(tmp_path / "arm.xml", [train], [other])
    assert answer.causes[0].effect == "transmission.spring"
    assert write_model(answer.internals.model, answer.internals.estimate, tmp_path / "closed.xml") == []
    assert diagnose(tmp_path / "closed.xml", [train], [other]).verdict == "no_gap"


def _sprung(stiffness: np.ndarray, rest: np.ndarray, seed: int) -> Recording:
    made = record(model(), Wrong(), seed=seed, seconds=30, noise=0.002, channels=("tau",))
    assert made.torque is not None
    return replace(made, torque=made.torque + stiffness * (made.position - rest))


def test_a_shared_motor_becomes_a_fixed_tendon(tmp_path):
    """Its inertia and friction load both joints; the model with it can be diagnosed again."""
    (tmp_path / "arm.xml").write_text(THREE)
    nominal = load_model(tmp_path / "arm.xml")
    recordings = []
    for seed in (1, 2):
        one = record(nominal.mujoco_model, Wrong(), seed=seed, seconds=30, noise=0.002, channels=("tau_motor",))
        _, _, v, a = motion(3, 30, 50.0, seed)
        speed, push = v[:, 2] + 0.8 * v[:, 1], a[:, 2] + 0.8 * a[:, 1]
        lost = 0.05 * push + 0.8 * np.tanh(speed / 0.002) + 0.3 * speed
        recordings.append(replace(one, motor_torque=one.motor_torque + lost[:, None] * np.array([0.0, 0.8, 1.0])))
    answer = diagnose(tmp_path / "arm.xml", recordings[:1], recordings[1:])
    assert answer.causes[0].effect == "transmission.coupling"
    assert write_model(nominal, answer.internals.estimate, tmp_path / "closed.xml") == []
    assert answer.rollout.after.max() < 0.2 * answer.rollout.before.max()
    motors = tendons_of(load_model(tmp_path / "closed.xml").mujoco_model, range(3))
    assert motors.turns == pytest.approx(np.array([[0.0, 0.8, 1.0]]), rel=0.05)
    fitted = [motors.armature[0], motors.frictionloss[0], motors.damping[0]]
    assert fitted == pytest.approx([0.05, 0.8, 0.3], rel=0.05)
    assert diagnose(tmp_path / "closed.xml", recordings[1:], recordings[:1]).verdict == "no_gap"


def test_two_motors_may_turn_with_the_same_pair_of_joints():
    spec = mujoco.MjSpec.from_string(THREE)
    pair = [SimpleNamespace(effect="transmission.coupling", place=2, shape=(2, lever)) for lever in (0.8, -0.6)]
    add_motors(spec, load_model(model()), SimpleNamespace(of=lambda term: np.array([0.05, 0.8, 0.3])), pair)
    assert tendons_of(spec.compile(), range(3)).turns == pytest.approx(np.array([[0.0, 0.8, 1.0], [0.0, -0.6, 1.0]]))


def test_an_arm_files_model_can_be_written_too(tmp_path):
    nominal = load_model("sarcos")
    write_model(nominal, SimpleNamespace(terms=()), tmp_path / "sarcos.xml")
    same = load_model(tmp_path / "sarcos.xml")
    q, v, a = np.random.default_rng(0).uniform(-1, 1, (3, 4, nominal.n))
    assert same.arm.torque(q, v, a) == pytest.approx(
        nominal.arm.torque(q, v, a), rel=1e-4, abs=1e-4
    )  # six digits are written


def test_a_joint_s_name_does_not_end_a_comment():
    from xml.etree import ElementTree

    from calib.arm.model_files import xml_comment

    comment = xml_comment(["first", "friction of a--->--><body/>: 3", "--"])
    assert [child.tag for child in ElementTree.fromstring(f"<mujoco>{comment}</mujoco>")] == []
    assert comment.startswith("<!-- first\n  friction of a- - ->")
