"""The model as MuJoCo moves it, against recordings that other code made with MuJoCo."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record, search_on

from armlink.recording.recording import Recording
from sim_gap.model.load import load_model
from sim_gap.position_gap.fit import LoopSearch, rms_on
from sim_gap.position_gap.plant import HeldParts, MovedModel, held_model, held_parts, servos_of
from sim_gap.position_gap.windows import pieces_of

READ = 2.0 * np.pi / 4096 / np.sqrt(12.0)
"""Standard deviation of a position that is read with 12 bits [rad]."""
TEXT = model_text(kp=15.0, friction=0.2)


def left(search: LoopSearch, **values: object) -> np.ndarray:
    """RMS that the nominal model leaves with other values, (J,) [rad]."""
    point = {**search.nominal, **{name: np.broadcast_to(x, 2).astype(float) for name, x in values.items()}}
    return rms_on(search.data, point)


def pid(text: str) -> str:
    spec = mujoco.MjSpec.from_string(text)
    for servo in spec.actuators:
        servo.set_to_pid(kp=15.0, kv=0.3, slewmax=1.0, ctrlspec=1)
        servo.delay, servo.nsample = 0.04, 90
    spec.compile()
    return spec.to_xml()


MODELS = {
    "as it is": TEXT,
    "joints that creep": model_text(kp=15.0, friction=0.2, creeps=True),
    "Euler": TEXT.replace("implicitfast", "Euler"),
    "Runge-Kutta": TEXT.replace("implicitfast", "RK4"),
    "a step of 4 ms": TEXT.replace("0.002", "0.004"),
    "a filter in the actuators": TEXT.replace("<position ", '<position timeconst="0.05" '),
    "damping within a limit": TEXT.replace('kp="15.0"', 'kp="15.0" kv="2" forcerange="-1 1"'),
    "gravity compensation": TEXT.replace('<body name="fore"', '<body gravcomp="1" name="fore"'),
}


@pytest.mark.parametrize("text", MODELS.values(), ids=MODELS.keys())
def test_a_models_own_recording_leaves_what_it_was_read_with(text: str) -> None:
    """The start of a window is a smoothed reading, whose error fades before it is judged."""
    search = search_on(text, [record(text, 1, 12.0)])
    assert (left(search) < 2.2 * READ).all()


def test_another_gain_shows() -> None:
    assert (left(search_on(model_text(kp=30.0, friction=0.2), [record(TEXT, 1, 12.0)])) > 0.01).all()


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("load", "breakaway"), [(0.3, (0.0, 1.0)), (0.0, (0.4, 0.1)), (0.0, (0.15, 0.03)), (0.2, (0.2, 0.1))]
)
def test_friction_that_mujoco_lacks_is_as_another_simulation_makes_it(load: float, breakaway) -> None:
    search = search_on(TEXT, [record(TEXT, 1, 12.0, load=load, breakaway=breakaway)])
    own = left(search, load=load, stribeck=breakaway[0], stribeck_velocity=breakaway[1])
    assert (own < 3.0 * READ).all()
    assert (left(search) > 2.0 * own).all()


def test_a_delay_is_one_of_the_command() -> None:
    seen = record(TEXT, 1, 12.0)
    assert seen.position_command is not None
    early = np.vstack([seen.position_command[2:], np.repeat(seen.position_command[-1:], 2, axis=0)])
    search = search_on(TEXT, [replace(seen, position_command=early)])
    assert (left(search, delay=0.04) < 2.2 * READ).all()
    assert (left(search) > 10.0 * READ).all()


def test_a_payload_and_a_zero_are_those_of_the_changed_model() -> None:
    load = '<body pos="0.2 0 0"><inertial pos="0 0 0" mass="0.2" diaginertia="1e-7 1e-7 1e-7"/></body>'
    real = TEXT.replace("</body></body></worldbody>", f"{load}</body></body></worldbody>")
    search = search_on(TEXT, [record(real, 1, 12.0)])
    payload = {"payload.mass": 0.2, "payload.x": 0.04, "payload.y": 0.0, "payload.z": 0.0}
    assert (left(search, **payload) < 2.5 * READ).all()
    seen, off = record(TEXT, 1, 12.0), np.array([0.15, 0.0])
    assert seen.position_command is not None
    shifted = replace(seen, position=seen.position - off, position_command=seen.position_command - off)
    search = search_on(TEXT, [shifted])
    assert (left(search, **{"zero0.angle": 0.15}) < 2.2 * READ).all()
    assert (left(search)[0] > 5.0 * READ).all()


def test_a_pid_with_slew_limit_and_delay_is_the_models() -> None:
    """Within a window the limited command is not known at the start, which shows for a while."""
    search = search_on(pid(TEXT), [record(pid(TEXT), 1, 12.0)])
    own = left(search)
    assert (own < 0.003).all()
    assert (left(search, delay=0.0) > 3.0 * own).all()
    assert (left(search, slew=np.inf) > 3.0 * own).any()


def test_a_missing_command_switches_the_servo_off() -> None:
    search = search_on(TEXT, [record(TEXT, 2, 12.0, released=6.0)])
    assert 0.2 < search.data.served.mean() < 0.8
    assert (left(search) < 3.0 * READ).all()
    braked = {"viscous": search.nominal["viscous"] - 0.3, "back_emf": 0.3}
    assert (left(search, **braked) > 3.0 * left(search)).any()
    on = search_on(TEXT, [record(TEXT, 2, 12.0)])
    np.testing.assert_allclose(left(on, **braked), left(on), rtol=1e-6)


def on_a_trunk(text: str) -> str:
    """The arm on a body that is free, beside another joint, with a floor that the trunk would lie on."""
    trunk = (
        '<geom type="plane" size="9 9 .1" pos="0 0 -.1"/><body name="trunk"><freejoint/>'
        '<geom type="box" size=".1 .1 .15" mass="3"/><body name="head"><joint axis="1 0 0"/>'
        '<inertial pos="0 0 .1" mass=".4" diaginertia=".01 .01 .01"/></body>'
    )
    return text.replace("<worldbody>", "<worldbody>" + trunk).replace("</worldbody>", "</body></worldbody>")


def test_what_is_outside_of_the_arm_is_held_and_touches_nothing() -> None:
    model = mujoco.MjModel.from_xml_string(on_a_trunk(TEXT))
    names = ("shoulder", "elbow")
    sim = load_model(model, names, 2, {name: model.joint(name).id for name in names})
    assert held_parts(sim) == ["trunk", "head"]
    data, fixed = mujoco.MjData(held := held_model(sim)), mujoco.MjData(mujoco.MjModel.from_xml_string(TEXT))
    places = held.jnt_qposadr[list(sim.joints)]
    alone = mujoco.MjModel.from_xml_string(TEXT)
    data.ctrl[:], fixed.ctrl[:] = (0.3, -0.4), (0.3, -0.4)
    parts = HeldParts.of(held, sim.joints)
    for _ in range(2000):
        mujoco.mj_step(held, data)
        parts.put_back(data)
        mujoco.mj_step(alone, fixed)
    np.testing.assert_allclose(data.qpos[places], fixed.qpos, atol=1e-6)
    np.testing.assert_allclose(data.qpos[:3], model.qpos0[:3], atol=1e-6)
    assert (model.dof_armature[:6] == 0.0).all()  # the user's model stays as it is


def test_a_models_own_pid_and_delay_are_its_controllers() -> None:
    """Behind a gear of 2 at the elbow: torque and speed at the joint; the shoulder has a P servo."""
    spec = mujoco.MjSpec.from_string(TEXT)
    servo = spec.actuator("elbow")
    servo.set_to_pid(kp=3.0, ki=2.0, kv=0.25, slewmax=8.0, ctrlspec=1)
    servo.gear[0], servo.delay, servo.nsample = 2.0, 0.012, 8
    actuator, own = servos_of(load_model(spec.compile()))
    assert actuator.tolist() == [0, 1]
    shoulder, elbow = np.transpose([own[name] for name in ("kp", "kv", "ki", "limit", "slew", "delay")])
    np.testing.assert_allclose(elbow, [12.0, 1.0, 8.0, np.inf, 4.0, 0.012])
    assert (shoulder[1:] == [0.0, 0.0, np.inf, np.inf, 0.0]).all()


@pytest.mark.parametrize("exact", [True, False])
def test_a_models_own_filter_of_the_command_is_its_controllers(exact: bool) -> None:
    spec = mujoco.MjSpec.from_string(MODELS["a filter in the actuators"])
    for servo in spec.actuators:
        servo.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT if exact else mujoco.mjtDyn.mjDYN_FILTER
    assert servos_of(load_model(spec.compile()))[1]["lag"].tolist() == [0.05, 0.05]


def test_the_efforts_that_a_urdf_states_limit_its_servos() -> None:
    text = model_text(kp=40.0, friction=0.0, limits=(3.0, 3.0)).replace(
        '<joint name="elbow"', '<joint name="elbow" actuatorfrcrange="-2 2"'
    )
    _, own = servos_of(load_model(mujoco.MjModel.from_xml_string(text)))
    assert own["limit"].tolist() == [3.0, 2.0]


def joined(*parts: Recording, gap: float) -> Recording:
    """Roll-outs one after the other, with so much time between [s]."""
    times, end = [], 0.0
    for part in parts:
        times.append(part.t - part.t[0] + end)
        end = float(times[-1][-1]) + 0.02 + gap
    position, command = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("position", "position_command")
    )
    return Recording(t=np.concatenate(times), position=position, position_command=command)


@pytest.mark.parametrize("gap", [0.0, 2.0])
@pytest.mark.parametrize("seed", [1, 5])
def test_short_roll_outs_begin_afresh_each(gap: float, seed: int) -> None:
    """Where rows are missing, and at a step that no motion makes."""
    parts = [record(TEXT, 10 * seed + k, 2.0, wide=2.0) for k in range(8)]
    seen = joined(*parts, gap=gap)
    starts = [piece.start for piece in pieces_of(seen)]
    jumps = [k * 100 for k in range(1, 8) if np.abs(seen.position[k * 100] - seen.position[k * 100 - 1]).max() > 0.3]
    assert set(starts) >= ({100 * k for k in range(8)} if gap else {0, *jumps})
    if gap:
        search = search_on(TEXT, [seen])
        assert (left(search) < 0.01).all()
        assert (left(search, kp=30.0) > 3.0 * left(search)).any()


def test_a_single_wild_reading_ends_nothing() -> None:
    seen = record(TEXT, 3, 8.0)
    seen.position[200] += 2.0
    assert pieces_of(seen) == [slice(0, 400)]


def test_a_model_without_servos_is_driven_through_springs() -> None:
    """The same motion as with servos of that gain and damping."""
    bare = TEXT.partition("<actuator>")[0] + "</mujoco>"
    search = search_on(bare, [record(TEXT, 1, 12.0)])
    assert not MovedModel(load_model(mujoco.MjModel.from_xml_string(bare))).driven.any()
    assert (left(search, kp=15.0) < 2.2 * READ).all()
