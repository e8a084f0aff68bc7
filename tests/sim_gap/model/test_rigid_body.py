"""The rigid arm against MuJoCo and Pinocchio: torque, regressor, payload and moved masses."""

import mujoco
import numpy as np
import pytest
from wrong_arms import THREE

from armlink.errors import BadInput
from gcomp.arm.inertials import moment_to_inertia
from gcomp.arm.rigid_body import RigidArm, torque_slopes
from sim_gap.model.load import load_model, rigid_arm


def random_arm(n: int, seed: int, slides: tuple[int, ...] = ()) -> str:
    """MJCF of a chain with random frames, axes, offset joints, inertias and a fixed body on every other link."""
    random = np.random.default_rng(seed)
    xml, close = "", ""
    for i in range(n):
        numbers = lambda k, low=-0.3, high=0.3: " ".join(f"{x:.6f}" for x in random.uniform(low, high, k))  # noqa: E731
        xml += f'<body name="b{i}" pos="{numbers(3)}" euler="{numbers(3, -2, 2)}">'
        kind = "slide" if i in slides else "hinge"
        xml += f'<joint name="j{i}" type="{kind}" axis="{numbers(3, 0.2, 1)}" pos="{numbers(3)}" ref="{numbers(1)}"/>'
        xml += f'<inertial pos="{numbers(3)}" mass="{random.uniform(0.3, 4):.4f}" '
        xml += f'diaginertia="0.03 0.025 {random.uniform(0.01, 0.05):.4f}" euler="{numbers(3, -2, 2)}"/>'
        if i % 2:
            xml += f'<body pos="{numbers(3)}" euler="{numbers(3)}"><inertial pos="{numbers(3)}" mass="0.4" '
            xml += 'diaginertia="0.002 0.003 0.004"/></body>'
        close += "</body>"
    option = '<compiler angle="radian"/><option gravity="1.0 -2.0 -9.0"/>'
    return f"<mujoco>{option}<worldbody>{xml}{close}</worldbody></mujoco>"


def inverse(model: mujoco.MjModel, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    data, out = mujoco.MjData(model), np.empty_like(q)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, data)
        out[k] = data.qfrc_inverse
    return out


def states(n: int, rows: int = 20, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-2, 2, (3, rows, n))


CHAINS = [(2, ()), (3, ()), (5, ()), (7, ()), (1, (0,)), (4, (2,)), (6, (0, 3, 5)), (3, (0, 1, 2))]


@pytest.mark.parametrize(("n", "slides"), CHAINS)
def test_torque_is_that_of_mujoco_on_random_arms(n: int, slides: tuple[int, ...]):
    model = mujoco.MjModel.from_xml_string(random_arm(n, n, slides))
    arm = rigid_arm(model, range(n))
    q, v, a = states(n)
    np.testing.assert_allclose(arm.torque(q, v, a), inverse(model, q, v, a), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("n", "slides"), CHAINS)
def test_regressor_times_parameters_is_the_torque(n: int, slides: tuple[int, ...]):
    arm = rigid_arm(mujoco.MjModel.from_xml_string(random_arm(n, 10 + n, slides)), range(n))
    q, v, a = states(n)
    motion = arm.motion(q, v, a)
    product = sum(arm.link_regressor(motion, link) @ arm.inertial[link] for link in range(n))
    np.testing.assert_allclose(product, arm.torque(q, v, a), rtol=1e-9, atol=1e-9)


def test_regressor_columns_are_finite_differences_of_mujocos_torque():
    model = mujoco.MjModel.from_xml_string(THREE)
    arm, (q, v, a) = rigid_arm(model, range(3)), states(3)
    motion, before = arm.motion(q, v, a), inverse(model, q, v, a)
    for link in range(3):
        shift, centre, mass = 1e-6, model.body_ipos[link + 1].copy(), model.body_mass[link + 1]
        model.body_ipos[link + 1, 1] += shift
        slope = (inverse(model, q, v, a) - before) / (mass * shift)
        model.body_ipos[link + 1] = centre
        own = arm.link_regressor(motion, link)
        moved = own[..., 1:4] + own[..., 4:] @ moment_to_inertia(arm.inertial[link, 1:4] / arm.inertial[link, 0])
        np.testing.assert_allclose(slope, moved[..., 1], atol=1e-4)


@pytest.mark.parametrize("text", [THREE, THREE.replace('name="joint_2"', 'name="joint_2" type="slide"')])
def test_torque_and_its_slopes_are_those_of_pinocchio(tmp_path, text):
    pin = pytest.importorskip("pinocchio")
    path = tmp_path / "arm.xml"
    path.write_text(text)
    model = pin.buildModelFromMJCF(str(path))
    arm, (q, v, a) = load_model(path, (), 3).arm, states(3)
    rows, data = list(zip(q, v, a, strict=True)), model.createData()
    expected = [pin.rnea(model, model.createData(), *row) for row in rows]
    np.testing.assert_allclose(arm.torque(q, v, a), expected, atol=1e-9)
    expected = np.array([np.copy(pin.computeRNEADerivatives(model, data, *row)) for row in rows])
    for joint in range(3):
        slopes = torque_slopes(arm, arm.motion(q, v, a)[0], q, v, a, joint)
        np.testing.assert_allclose(slopes[0], expected[:, 0, :, joint], atol=1e-6)
        np.testing.assert_allclose(slopes[1], expected[:, 1, :, joint], atol=1e-9)
        columns = np.triu(expected[:, 2]) + np.swapaxes(np.triu(expected[:, 2], 1), 1, 2)
        np.testing.assert_allclose(slopes[2], columns[:, :, joint], atol=1e-9)


def test_joint_terms_of_the_model_count_on_the_motor_side_and_springs_beside_it():
    xml = THREE.replace('name="joint_2"', 'name="joint_2" armature="0.3" damping="0.7" stiffness="2" springref="0"')
    model = mujoco.MjModel.from_xml_string(xml)
    arm, (q, v, a) = rigid_arm(model, range(3)), states(3)
    extra = inverse(model, q, v, a) - arm.torque(q, v, a)
    np.testing.assert_allclose(arm.nominal_joint_torque(v, a, np.sign(v)) + arm.spring_torque(q), extra, atol=1e-9)
    np.testing.assert_allclose(arm.carried(q, v, a), arm.torque(q, v, a) + arm.spring_torque(q))


def test_a_model_that_is_not_a_plain_chain_is_refused(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(THREE.replace("</mujoco>", '<option density="50" viscosity="9"/></mujoco>'))
    with pytest.raises(BadInput, match=r"joint_\d.*expected a plain chain of joints"):
        load_model(path)


def test_gravity_compensation_is_the_controllers_and_no_torque_of_the_links(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(THREE)
    own = load_model(path).arm
    path.write_text(THREE.replace('<body name="link_3"', '<body gravcomp="1" name="link_3"'))
    model = load_model(path)
    np.testing.assert_array_equal(model.arm.torque(*states(3)), own.torque(*states(3)))
    assert model.mujoco_model.body_gravcomp.max() == 1.0


def test_joints_are_found_by_name_and_the_others_stay_locked(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(THREE)
    some = load_model(path, ("joint_1", "joint_3"), 2)
    assert some.arm.names == ("joint_1", "joint_3")
    q, v, a = states(2)
    whole: RigidArm = load_model(path).arm
    full = [np.insert(x, 1, 0.0, axis=1) for x in (q, v, a)]
    np.testing.assert_allclose(some.arm.torque(q, v, a), whole.torque(*full)[:, [0, 2]], atol=1e-9)
