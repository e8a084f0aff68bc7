"""The blind check's plant: it moves by the true mechanics, and an effect shows in the right channels."""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from armlink.recording.files import load_recording
from sim_bus.effects.registry import imperfections
from sim_gap.blind.arms import BenchArm, draw_arm
from sim_gap.blind.cases import make_case
from sim_gap.blind.effects import DRAWS, EFFECTS
from sim_gap.blind.motion import KINDS, RATE, MotionLimits, derivatives, trajectory
from sim_gap.blind.plant import Log, TrueArm, controller_bandwidth, joint_sensors, record, simulate, true_arm
from sim_gap.blind.recipe import CaseRecipe
from sim_gap.blind.scene import Scene
from sim_gap.blind.servo_plant import Bristles

ALL = {
    "link.mass_moment",
    "link.inertia",
    "link.payload",
    "base.tilt",
    "position.offset",
    "position.gain",
    "position.eccentricity",
    "torque.offset",
    "torque.gain",
    "torque.drift",
    "torque.crosstalk",
    "torque.hysteresis",
    "torque.deadband",
    "torque.saturation",
    "timing.delay",
    "friction.coulomb",
    "friction.viscous",
    "friction.stribeck",
    "friction.asymmetric",
    "friction.load",
    "transmission.ripple",
    "transmission.spring",
    "transmission.elasticity",
    "transmission.backlash",
    "transmission.coupling",
    "actuator.gain",
    "actuator.rotor_inertia",
    "actuator.lag",
    "actuator.delay",
    "actuator.saturation",
}
SENSOR_ONLY = ("torque.", "timing.")
MOTOR_ONLY = ("friction.", "transmission.ripple", "transmission.coupling", "actuator.gain", "actuator.rotor_inertia")
COMMAND_ONLY = ("actuator.lag", "actuator.delay", "actuator.saturation")


def limits(n: int) -> MotionLimits:
    return MotionLimits(np.full(n, -1.5), np.full(n, 1.5), np.linspace(1.0, 2.0, n), np.linspace(3.0, 8.0, n))


@pytest.fixture(scope="module")
def no_effect() -> tuple[TrueArm, np.ndarray, Log]:
    random = np.random.default_rng(3)
    arm = draw_arm(random, 5)
    scene = Scene(arm, trajectory(("sines",), 8.0, limits(5), random))
    truth = true_arm(arm, scene.rated, random)
    return truth, scene.command, simulate(truth, scene, scene.command, controller_bandwidth(truth), 7)


def link_motion(truth: TrueArm, log: Log) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True angles, velocities and accelerations but for the first and the last row."""
    angle = joint_sensors(truth).angle_of(log.position)
    return angle[1:-1], derivatives(angle)[0][1:-1], (angle[2:] - 2 * angle[1:-1] + angle[:-2]) * RATE**2


def test_link_torque_is_pinocchios_for_the_true_arm(no_effect: tuple[TrueArm, np.ndarray, Log]) -> None:
    truth, _command, log = no_effect
    model = _pinocchio(truth.arm)
    inner = slice(20, -20)
    data = model.createData()
    motion = (part[inner] for part in link_motion(truth, log))
    expected = np.array([pin.rnea(model, data, *row) for row in zip(*motion, strict=True)])
    # the torque of one instant against a second difference over 4 ms: equal but for the controller's own noise
    left = np.sqrt(((log.torque[1:-1][inner] - expected) ** 2).mean(0))
    assert (left < 0.01 * np.abs(log.torque).max(0) + 0.01).all()


def _pinocchio(arm: BenchArm) -> pin.Model:
    model, parent = pin.Model(), 0
    model.gravity.linear = arm.gravity
    for k in range(arm.n):
        placement = pin.SE3(arm.rotation[k], arm.offset[k])
        joint = pin.JointModelRevoluteUnaligned(arm.axis[k])
        parent = model.addJoint(parent, joint, placement, arm.names[k])
        model.appendBodyToJoint(parent, pin.Inertia(arm.mass[k], arm.com[k], arm.inertia[k]), pin.SE3.Identity())
    return model


def test_motor_torque_is_link_torque_plus_rotor_and_friction(no_effect: tuple[TrueArm, np.ndarray, Log]) -> None:
    truth, _command, log = no_effect
    state, (_, velocity, acceleration) = truth.state, link_motion(truth, log)
    rest = state.actuator_gain * log.motor[1:-1] - log.torque[1:-1] - truth.arm.armature * acceleration
    moving = np.abs(velocity) > 0.1
    most = state.coulomb + state.viscous * np.abs(velocity)
    mean = np.array([rest[m, j].mean() for j, m in enumerate((moving & (velocity > 0)).T)])
    assert (np.abs(mean) < most.max(0) + 0.02).all()
    assert (mean > 0.0).all()


def test_arm_stays_on_its_trajectory(no_effect: tuple[TrueArm, np.ndarray, Log]) -> None:
    _truth, command, log = no_effect
    assert np.abs(log.position - command).max() < 0.05


def test_recording_is_uneven_quantised_and_complete(no_effect: tuple[TrueArm, np.ndarray, Log]) -> None:
    truth, command, log = no_effect
    columns = record(truth, command, log, np.random.default_rng(0))
    step = np.diff(columns["t"])
    assert columns["t"][0] == 0.0
    assert (step > 0).all()
    assert 0.003 < np.median(step) < 0.005
    assert np.unique(step.round(7)).size > 100
    counts = columns["q"] / truth.encoder_step
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
    assert all(
        columns[name].shape == (len(step) + 1, 5) for name in ("q", "dq", "tau", "tau_motor", "tau_cmd", "q_cmd")
    )
    motor_counts = columns["tau_motor"] / (1e-3 * truth.rated)
    np.testing.assert_allclose(motor_counts, np.rint(motor_counts), atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_trajectories_keep_their_limits_and_rest_at_both_ends(kind: str) -> None:
    bounds = limits(4)
    q = trajectory((kind, "chirp"), 40.0, bounds, np.random.default_rng(5))
    v, a = derivatives(q)
    assert (q > bounds.lower).all()
    assert (q < bounds.upper).all()
    assert (np.abs(v).max(0) < 1.3 * bounds.velocity).all()
    assert (np.abs(a).max(0) < 1.6 * bounds.acceleration).all()
    np.testing.assert_allclose(v[[0, -1]], 0.0, atol=1e-3)
    assert (np.ptp(q, axis=0) > 0.3).all()


def test_point_to_point_motion_always_comes_back() -> None:
    """Otherwise the command would jump at the start of the next kind of motion, and drives be rated for that jump."""
    bounds = limits(4)
    for seed in range(60):
        q = trajectory(("points", "sweeps"), 30.0, bounds, np.random.default_rng(seed))
        assert (np.abs(derivatives(q)[1]).max(0) < 1.6 * bounds.acceleration).all()


def test_a_short_motion_from_point_to_point_moves_and_comes_back() -> None:
    bounds = limits(4)
    for seed in range(30):
        q = trajectory(("points",), 5.0, bounds, np.random.default_rng(seed))
        assert np.ptp(q, axis=0).max() > 0.0
        np.testing.assert_allclose(q[-1], q[0], atol=1e-9)


def _bristles(coulomb: float) -> Bristles:
    state = imperfections(("a", "b", "c"), ())
    state.coulomb[:] = coulomb
    return Bristles(state, np.full(3, 0.1), 5e-4)


def test_friction_slides_at_coulombs_level() -> None:
    bristles = _bristles(2.0)
    for _ in range(400):
        force = bristles.force(np.full(3, 0.3), np.zeros(3))
    np.testing.assert_allclose(force, 2.0, rtol=1e-3)


def test_friction_does_not_creep_at_rest() -> None:
    """A mass on bristles, pushed with half of breakaway and shaken by noise, stays: plain LuGre would wander off."""
    bristles, random = _bristles(2.0), np.random.default_rng(1)
    x, v = np.zeros(3), np.zeros(3)
    places = []
    for _ in range(20000):
        push = 1.0 + 0.3 * random.standard_normal(3)
        v += 5e-4 * (push - bristles.force(v, np.zeros(3))) / 0.1
        x += 5e-4 * v
        places.append(x.copy())
    settled = np.array(places)[2000:]
    assert np.abs(settled[-2000:].mean(0) - settled[:2000].mean(0)).max() < 1e-5


def test_every_effect_is_drawn() -> None:
    assert set(EFFECTS) == set(DRAWS) == ALL


SHOWN = (
    "link.mass_moment",
    "position.offset",
    "torque.hysteresis",
    "timing.delay",
    "friction.coulomb",
    "transmission.elasticity",
    "transmission.coupling",
    "actuator.rotor_inertia",
    "actuator.delay",
)


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A short case of an effect of every kind, made as the check makes them; the labels by effect."""
    folder = tmp_path_factory.mktemp("blind")
    wanted = [CaseRecipe(f"case_{k:04d}", (effect,), (23, k)) for k, effect in enumerate(SHOWN)]
    for recipe in wanted:
        make_case(recipe, folder / "cases", folder / "labels", train_s=10.0, heldout_s=7.0)
    found = [json.loads(path.read_text()) for path in sorted((folder / "labels").glob("*.json"))]
    return {label["effects"][0]["effect"]: label for label in found}


@pytest.mark.long
@pytest.mark.parametrize("effect", SHOWN)
def test_effect_shows_in_its_channels_only(labels: dict[str, Any], effect: str) -> None:
    gaps = labels[effect]["gap"]
    assert labels[effect]["clear"]
    added = {c: np.square(gaps["with"][c]) - np.square(gaps["without"][c]) for c in gaps["with"]}
    shown = {channel: float(np.sqrt(max(x.max(), 0.0))) for channel, x in added.items()}
    if effect.startswith(SENSOR_ONLY):
        assert max(shown["tau_motor"], shown["tau_cmd"]) < 0.4 * shown["tau"]
    elif effect.startswith(MOTOR_ONLY):
        assert shown["tau"] < 0.4 * shown["tau_motor"]
        assert shown["tau_cmd"] == pytest.approx(shown["tau_motor"], rel=0.3)
    elif effect in COMMAND_ONLY:
        assert max(shown["tau"], shown["tau_motor"]) < 0.5 * shown["tau_cmd"]
    else:  # link and position: the same torque in all three
        assert shown["tau_motor"] == pytest.approx(shown["tau"], rel=0.5)
        assert shown["tau_cmd"] == pytest.approx(shown["tau_motor"], rel=0.3)


def test_cases_are_the_same_for_the_same_seed(tmp_path: Path) -> None:
    wanted = CaseRecipe("case_0000", ("friction.coulomb",), (5, 1))
    for folder in ("a", "b"):
        make_case(wanted, tmp_path / folder, tmp_path / f"{folder}_labels", train_s=3.0, heldout_s=3.0)
    for name in ("sim.xml", "train.csv", "heldout.csv"):
        assert (tmp_path / "a/case_0000" / name).read_bytes() == (tmp_path / "b/case_0000" / name).read_bytes()


def test_a_case_that_no_arm_shows_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(DRAWS, "torque.offset", lambda scene, random: None)
    monkeypatch.setattr("sim_gap.blind.recipe.ATTEMPTS", 3)
    for wanted in (CaseRecipe("case_0000", ("torque.offset",), (6, 1)), CaseRecipe("case_0001", (), (6, 2))):
        make_case(wanted, tmp_path / "c", tmp_path / "l", train_s=3.0, heldout_s=3.0)
    assert [path.name for path in (tmp_path / "c").iterdir()] == ["case_0001"]


def test_nominal_model_and_recordings_load(tmp_path: Path) -> None:
    make_case(CaseRecipe("case_0000", (), (6, 1)), tmp_path / "c", tmp_path / "l", train_s=4.0, heldout_s=3.0)
    recording = load_recording(tmp_path / "c/case_0000/train.csv")
    label = json.loads((tmp_path / "l/case_0000.json").read_text())
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "c/case_0000/sim.xml"))
    assert recording.n == model.nv == label["n"]
    assert label["effects"] == []
    assert not {"labels", "label"} & {path.name for path in (tmp_path / "c").rglob("*")}
