"""A payload of positions alone: a point with mass, mass moments and the inertia that follows from them."""

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record

from sim_gap.model.load import load_model
from sim_gap.model.rigid_body import inertial_of
from sim_gap.position_gap.columns import PAYLOAD_INERTIA, payload_inertia, with_columns
from sim_gap.position_gap.controller import nominal_controller, nominal_point
from sim_gap.position_gap.fit import LoopFit, evaluate
from sim_gap.position_gap.judge import joint_rms
from sim_gap.position_gap.windows import windows_of

TEXT = model_text(kp=40.0, friction=0.0, damping=1.0)
SIM = load_model(mujoco.MjModel.from_xml_string(TEXT))


@pytest.mark.parametrize("mass", [0.3, -0.1])
def test_its_inertia_is_that_of_a_point(mass: float) -> None:
    centre = np.array([0.12, -0.03, 0.05])
    moment = mass * centre
    found = payload_inertia(np.array(mass), (moment[0], moment[1], moment[2]), SIM.arm)
    assert list(found.values()) == pytest.approx(inertial_of(mass, centre, np.zeros((3, 3)))[4:].tolist())
    assert list(found) == list(PAYLOAD_INERTIA)


def test_a_moment_with_next_to_no_mass_is_no_further_away_than_the_arm_is_long() -> None:
    found = payload_inertia(np.array(1e-6), (np.array(0.1), np.array(0.0), np.array(0.0)), SIM.arm)
    assert found["payload.zz"] == pytest.approx(0.1 * (0.2 + 0.1))


def test_it_moves_as_in_mujoco() -> None:
    """Without its inertia, fits made up for it by a centre far away and a mass moment against it."""
    mass, place = 0.3, 0.3
    load = f'<body pos="{place} 0 0"><inertial pos="0 0 0" mass="{mass}" diaginertia="1e-7 1e-7 1e-7"/></body>'
    real = TEXT.replace("</body></body></worldbody>", f"{load}</body></body></worldbody>")
    data = with_columns(windows_of(SIM.arm, [record(real, 1, 20.0, fast=2.0)], ["run"]))
    early = np.full(2, 0.5 * SIM.mujoco_model.opt.timestep)
    values = {"payload.mass": np.full(2, mass), "payload.x": np.full(2, mass * place), "early": early}
    point = {**nominal_point(data, nominal_controller(SIM)), **values}
    left = joint_rms(data, evaluate(data, LoopFit(point, ((), ()))).rms)
    for name in PAYLOAD_INERTIA:
        data.columns.pop(name, None)
    without = joint_rms(data, evaluate(data, LoopFit(point, ((), ()))).rms)
    assert (without > 3.0 * left).all()


def test_the_efforts_that_a_urdf_states_limit_its_servos() -> None:
    text = model_text(kp=40.0, friction=0.0, limits=(3.0, 3.0)).replace(
        '<joint name="elbow"', '<joint name="elbow" actuatorfrcrange="-2 2"'
    )
    own = nominal_controller(load_model(mujoco.MjModel.from_xml_string(text)))
    assert own.limit.tolist() == [3.0, 2.0]
