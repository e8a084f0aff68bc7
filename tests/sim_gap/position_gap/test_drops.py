"""Servos that hold, and are switched off: what falls then shows friction and rotor, though no command moves."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from servo_arm import weight_text

from armlink.recording.corrections import AS_IT_IS
from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.checks.check import check_position_only
from sim_gap.model.load import load_model, parse_known_gains

COUNT = 2 * np.pi / 4096


def drop(text: str, held: float, seconds: float, start: float) -> Recording:
    """Held at `start` [rad] for a time [s], then let go."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    t = np.arange(0.0, seconds, 0.02)
    q, command = np.empty((len(t), 1)), np.full((len(t), 1), start)
    data.qpos[:] = start
    for k, now in enumerate(t):
        q[k] = data.qpos
        if now >= held:
            model.actuator_gainprm[:], model.actuator_biasprm[:], command[k] = 0.0, 0.0, np.nan
        data.ctrl[:] = start
        mujoco.mj_step(model, data, 10)
    return Recording(t=t, position=np.rint(q / COUNT) * COUNT, position_command=command)


POSITION = '<position name="servo" joint="servo" kp="30" kv="2"/>'


@pytest.mark.long
def test_drops_show_friction_and_rotor(tmp_path: Path) -> None:
    random = np.random.default_rng(1128)
    friction, armature = random.uniform(0.2, 0.35), random.uniform(0.015, 0.025)
    real = weight_text(friction, armature, POSITION)
    sim = tmp_path / "sim.xml"
    sim.write_text(weight_text(0.1, 0.005, POSITION), encoding="utf-8")
    drops = [drop(real, random.uniform(0.5, 2.0), 5.0, random.uniform(-0.3, 0.2)) for _ in range(4)]
    found = diagnose(str(sim), drops[:2], drops[2:])
    assert (found.heldout_after < 0.15 * found.heldout_before).all()
    point = found.internals.fit.point
    assert point["coulomb"][0] == pytest.approx(friction, rel=0.15)
    assert point["armature"][0] == pytest.approx(armature, rel=0.3)


@pytest.mark.long
def test_known_gains_are_the_models(tmp_path: Path) -> None:
    """Of a model with a motor; what is written has a position actuator."""
    random = np.random.default_rng(1128)
    t, kp = np.arange(0.0, 12.0, 0.02), float(random.uniform(20.0, 40.0))
    text = weight_text(0.1, 0.01, POSITION.replace('kp="30"', f'kp="{kp}"'))
    model = mujoco.MjModel.from_xml_string(text)
    recordings = []
    for phase in random.uniform(0.0, 6.0, 2):
        data, q = mujoco.MjData(model), np.empty((len(t), 1))
        command = 0.5 * (np.sin(2.0 * t + phase) + 0.4 * np.sin(7.0 * t))[:, None]
        data.qpos[:] = command[0]
        for k, row in enumerate(command):
            q[k], data.ctrl[:] = data.qpos, row
            mujoco.mj_step(model, data, 10)
        recordings.append(Recording(t=t, position=q, position_command=command))
    sim = tmp_path / "sim.xml"
    sim.write_text(weight_text(0.1, 0.01, '<motor name="servo" joint="servo"/>'), encoding="utf-8")
    found = diagnose(str(sim), recordings[:1], recordings[1:], known_gains=parse_known_gains(f"kp={kp},kd=2"))
    assert found.verdict == "no_gap"
    assert (found.heldout_before < 1e-3).all()


def test_a_short_roll_out_alone_is_no_proof_of_a_wrong_sign() -> None:
    """A square wave of a second, half a period behind, among others that follow."""
    random = np.random.default_rng(1128)
    text = weight_text(0.1, 0.01, POSITION)
    arm = load_model(mujoco.MjModel.from_xml_string(text)).arm
    recordings = []
    for late in (0.0, 0.0, 0.0, 0.5):
        t = np.arange(0.0, 1.0, 0.02)
        size = random.uniform(0.2, 0.6)
        command, q = (size * np.sign(np.sin(2 * np.pi * (t - shift) + 0.1))[:, None] for shift in (0.0, late))
        recordings.append(Recording(t=t, position=q, position_command=command, names=("servo",)))
    labels = [f"run {k}" for k in range(4)]
    checked, _ = check_position_only(arm, recordings, labels, AS_IT_IS)
    assert len(checked) == 4
