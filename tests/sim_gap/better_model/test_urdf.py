"""Corrected models as URDF: the same torques as the MJCF, by MuJoCo and by Pinocchio; what it cannot hold is said."""

from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import pytest
from wrong_arms import THREE, Wrong, model, record

from armlink.errors import BadInput
from calib.arm.model_files import urdf_of
from sim_gap.attribution.diagnose import diagnose
from sim_gap.better_model.export import write_model
from sim_gap.model.load import load_compiled, urdf_behind

ROOT = Path(__file__).parents[3]
TWO_AXES = """<mujoco><worldbody><body name="a" pos="0 0 1" euler="0 30 0"><joint name="x" axis="1 0 0" pos="0 0.1 0"/>
<joint name="z" axis="0 0 1" ref="20" range="-90 90" frictionloss="0.2"/><geom size="0.1" mass="1" pos="0.1 0.2 0.3"/>
<body pos="0.3 0 0"><geom type="box" size="0.1 0.2 0.3" mass="2" euler="10 20 30"/>
<body name="c"><joint name="out" type="slide" axis="0 1 1" stiffness="3"/><geom size="0.05" mass="0.5"/></body>
</body></body>
</worldbody></mujoco>"""


def torques(model: mujoco.MjModel, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Rigid-body torque by MuJoCo."""
    data, out = mujoco.MjData(model), np.zeros(model.nv)
    data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_comVel(model, data)
    mujoco.mj_rne(model, data, 1, out)
    return out


@pytest.mark.parametrize("source", ["tests/models/ur10e.urdf", "tests/models/own.xml", "sim_bus/arms/openarm.xml", ""])
def test_mujoco_and_pinocchio_get_the_same_torques_from_it(tmp_path, source):
    path = ROOT / source if source else tmp_path / "two.xml"
    (tmp_path / "two.xml").write_text(TWO_AXES)
    nominal = load_compiled(path)
    text, _ = urdf_of(nominal, urdf_behind(path))
    (tmp_path / "made.urdf").write_text(text)
    made = load_compiled(tmp_path / "made.urdf")
    other = pinocchio.buildModelFromXML(text)
    order = [other.joints[other.getJointId(nominal.joint(j).name)].idx_v for j in range(nominal.njnt)]
    assert other.nv == other.nq or "continuous" in text
    random = np.random.default_rng(2)
    for _ in range(10):
        q, v, a = (random.uniform(-1.0, 1.0, nominal.nv) for _ in range(3))
        expected = torques(nominal, q, v, a)
        np.testing.assert_allclose(torques(made, q, v, a), expected, rtol=1e-6, atol=1e-6)
        theirs = pinocchio.rnea(
            other, other.createData(), pinocchio_q(other, order, q), *(x[np.argsort(order)] for x in (v, a))
        )
        np.testing.assert_allclose(theirs[order], expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(made.dof_frictionloss, nominal.dof_frictionloss)


def pinocchio_q(model: pinocchio.Model, order: list[int], q: np.ndarray) -> np.ndarray:
    """Positions as Pinocchio takes them: cosine and sine of a continuous joint."""
    out = pinocchio.neutral(model)
    for joint in list(model.joints)[1:]:
        if joint.nv == 1:
            value = q[order.index(joint.idx_v)]
            out[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
    return out


@pytest.mark.long
def test_a_diagnosis_writes_urdf_and_says_what_it_lacks(tmp_path):
    (tmp_path / "arm.xml").write_text(THREE)
    wrong = Wrong(coulomb=np.full(3, 0.6), payload=0.8, rotor=np.array([0.8, 0.0, 0.0]), load=np.array([0.0, 0.3, 0.0]))
    made = record(model(), wrong, seed=1, seconds=40, noise=0.002, channels=("tau_motor",))
    inside = diagnose(tmp_path / "arm.xml", [made]).internals
    lines = write_model(inside.model, inside.estimate, tmp_path / "closed.urdf")
    write_model(inside.model, inside.estimate, tmp_path / "closed.xml")
    assert any(line.startswith("armature of joint_1: ") for line in lines)
    assert any(line.startswith("friction.load joint_2") for line in lines)
    text = (tmp_path / "closed.urdf").read_text()
    assert all(line in text for line in lines)
    as_urdf, as_mjcf = (load_compiled(tmp_path / f"closed.{kind}") for kind in ("urdf", "xml"))
    q, v, a = np.random.default_rng(1).normal(0.0, 0.7, (3, 3))
    np.testing.assert_allclose(torques(as_urdf, q, v, a), torques(as_mjcf, q, v, a), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(as_urdf.dof_frictionloss, as_mjcf.dof_frictionloss, rtol=1e-5)
    assert (as_urdf.dof_frictionloss > 0.3).all()


def test_a_urdf_keeps_its_shapes_and_says_that_zeros_moved(tmp_path):
    path = ROOT / "tests" / "models" / "ur10e.urdf"
    nominal = load_compiled(path)
    nominal.qpos0[1] = 0.05
    text, lines = urdf_of(nominal, path)
    assert "package://ur_description/meshes/ur10e/collision/shoulder.stl" in text
    assert lines == ["zero of shoulder_lift_joint: the arm reads 0.05 rad more than a simulation of this file"]


def test_a_ball_joint_is_refused():
    ball = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint type="ball"/><geom size="1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(BadInput, match="only hinges and slides"):
        urdf_of(ball, None)
