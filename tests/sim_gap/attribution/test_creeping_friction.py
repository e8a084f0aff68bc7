"""Torques of a simulated arm whose friction creeps, as MuJoCo's usual solver parameters make it."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from servo_arm import JOINTS, model_text, written

from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose

RATE, SECONDS = 100, 30
MASS, PLACE = 0.25, (0.12, 0.0, 0.03)


def arm(load: str = "") -> str:
    """The arm with light joints, which creep the faster; with a load at its end."""
    text = model_text(kp=20.0, friction=0.8, damping=0.3, creeps=True).replace('armature="0.02"', 'armature="0.003"')
    return text.replace("</body></body></worldbody>", f"{load}</body></body></worldbody>")


def measured(text: str, seed: int) -> Recording:
    """Positions, velocities and the motors' torques along smooth commands."""
    random = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    per, steps = round(1.0 / RATE / model.opt.timestep), round(SECONDS / model.opt.timestep)
    t = np.arange(steps) * model.opt.timestep
    waves, phase = random.uniform(0.03, 0.15, (3, 2)), random.uniform(0.0, 6.0, (3, 2))
    command = 0.4 * np.sin(2.0 * np.pi * waves * t[:, None, None] + phase).sum(1)
    data.qpos[:] = command[0]
    rows = []
    for k, each in enumerate(command):
        data.ctrl[:] = each
        if k % per == 0:
            mujoco.mj_forward(model, data)
            rows.append(np.concatenate([data.qpos, data.qvel, data.qfrc_actuator]))
        mujoco.mj_step(model, data)
    q, v, torque = np.split(np.array(rows), 3, axis=1)
    noise = 0.003 * random.standard_normal(torque.shape)
    return Recording(t=t[::per], position=q, velocity=v, motor_torque=torque + noise, names=JOINTS)


@pytest.fixture(scope="module")
def sim(tmp_path_factory) -> Path:
    return written(tmp_path_factory.mktemp("creeping"), arm())


@pytest.mark.long
def test_an_arm_like_its_model_has_no_gap(sim: Path) -> None:
    """Creep was told as friction that rises with the velocity, a negative breakaway of 0.9, with more than 0.8."""
    answer = diagnose(sim, [measured(arm(), 1), measured(arm(), 2)], [measured(arm(), 3)])
    assert answer.verdict == "no_gap"


@pytest.mark.long
def test_a_payload_is_told_alone(sim: Path) -> None:
    place = " ".join(map(str, PLACE))
    load = f'<body pos="{place}"><inertial pos="0 0 0" mass="{MASS}" diaginertia="1e-6 1e-6 1e-6"/></body>'
    answer = diagnose(sim, [measured(arm(load), 1), measured(arm(load), 2)], [measured(arm(load), 3)])
    assert [cause.effect for cause in answer.causes] in (["link.payload"], ["link.mass_moment"])
    assert answer.heldout_after.max() < 0.1 * answer.heldout_before.max()
