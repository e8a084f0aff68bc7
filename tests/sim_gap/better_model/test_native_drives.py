"""Drives in the model's own motors move the arm as the module's do."""

import mujoco
import numpy as np
import pytest

from sim_gap.better_model.forward_effects import Effects
from sim_gap.better_model.native_drives import DRIVE, hold, motors_of, put_delay, put_drive

STEP = 0.001
MODEL = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
<joint name="a" axis="0 1 0" damping="0.5"/><geom size="0.1" mass="2" pos="0.3 0 0"/><body pos="0.5 0 0">
<joint name="b" axis="0 1 0" damping="0.5"/><geom size="0.1" mass="1" pos="0.3 0 0"/></body></body></worldbody>
<actuator><motor name="a" joint="a" gear="{gear}"/><motor name="b" joint="b"/>{servo}</actuator></mujoco>"""
FOUND = {
    "gain": {"actuator.gain": 0.8},
    "limit": {"actuator.saturation": 6.0},
    "lag": {"actuator.lag": 0.04},
    "delay": {"actuator.delay": 0.03},
    "all": {"actuator.gain": 0.9, "actuator.saturation": 7.0, "actuator.lag": 0.02, "actuator.delay": 0.02},
}


def command(t: float) -> np.ndarray:
    return np.array([9.0 * np.sin(7.0 * t) - 6.0, 2.0 * np.cos(11.0 * t)])


def moved(model: mujoco.MjModel, effects: Effects | None, gear: float) -> np.ndarray:
    """Positions over a second, under torques that the model's motors make, or the drives of the module."""
    data, out = mujoco.MjData(model), []
    if effects is not None:
        effects.made(np.zeros(2), -STEP)
    for k in range(1000):
        now = command(k * STEP)
        if effects is None:
            data.ctrl[:2] = now / (gear, 1.0)
        else:
            data.qfrc_applied[:] = effects.made(now, k * STEP)
        mujoco.mj_step(model, data)
        out.append(data.qpos.copy())
    return np.array(out)


@pytest.mark.parametrize("gear", [1.0, 50.0])
@pytest.mark.parametrize("name", FOUND)
def test_a_motor_does_what_the_module_does(name, gear):
    spec = mujoco.MjSpec.from_string(MODEL.format(gear=gear, servo=""))
    plain = spec.compile()
    put_drive(motors_of(spec)["a"], FOUND[name])
    native = mujoco.MjModel.from_xml_string((spec.compile(), spec.to_xml())[1])
    listed = [(effect, "a", {DRIVE[effect]: value}) for effect, value in FOUND[name].items()]
    theirs, ours = moved(plain, Effects(plain, listed, ("a", "b")), gear), moved(native, None, gear)
    without = moved(plain, None, gear)
    apart = np.abs(ours - theirs).max()
    assert apart < 0.05 * np.abs(without - theirs).max(), (apart, np.abs(without - theirs).max())


def test_a_controller_of_positions_is_no_motor():
    spec = mujoco.MjSpec.from_string(MODEL.format(gear=1.0, servo='<position joint="b" kp="5"/>'))
    spec.delete(spec.actuators[1])
    assert list(motors_of(spec)) == ["a"]


@pytest.mark.parametrize(
    ("delay", "pid"),
    [(0.05, {}), (0.0, {"slewmax": 3.0}), (0.0, {"ki": 30.0}), (0.05, {"slewmax": 3.0, "ki": 30.0})],
)
@pytest.mark.parametrize("gear", [1.0, 2.0])
def test_a_joint_that_is_held_stays_where_it_is(delay, pid, gear):
    """A command of less than a radian, and a weight that only an integral part carries without an error."""
    spec = mujoco.MjSpec.from_string(MODEL.format(gear=1.0, servo=""))
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for joint in "ab":
        made = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        made.gear[0] = gear
        if pid:
            made.set_to_pid(kp=60.0 / gear**2, kv=0.0, ctrlspec=1, **pid)
        else:
            made.set_to_position(kp=60.0 / gear**2)
        put_delay(made, delay)
    if "ki" not in pid:
        spec.option.gravity = [0.0, 0.0, 0.0]
    model = spec.compile()
    rests, commands = np.array([0.8, -0.5]), gear * np.array([0.8, -0.5])

    def furthest(held: bool) -> float:
        data = mujoco.MjData(model)
        data.qpos[:] = rests
        if held:
            hold(model, data, [0, 1], commands)
        away = 0.0
        for _ in range(300):
            data.ctrl[:] = commands
            mujoco.mj_step(model, data)
            away = max(away, float(np.abs(data.qpos - rests).max()))
        return away

    assert furthest(held=True) < 1e-3
    assert furthest(held=False) > 0.05


def test_a_lag_is_held_at_its_command():
    spec = mujoco.MjSpec.from_string(MODEL.format(gear=1.0, servo=""))
    put_drive(motors_of(spec)["a"], {"actuator.lag": 0.1, "actuator.delay": 0.02})
    model = spec.compile()
    data = mujoco.MjData(model)
    hold(model, data, [0, 1], np.array([9.0, 2.0]))
    for _ in range(5):
        mujoco.mj_step(model, data)
        assert data.actuator_force == pytest.approx([9.0, 2.0])
