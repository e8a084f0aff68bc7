"""Effects that act on each other: columns are evaluated about the estimate, and large angles are exact."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from wrong_arms import THREE, Wrong, model, record

from armlink.model_file import compile_model
from armlink.recording.recording import Recording
from gcomp.arm.inertials import move_mass, point_mass, point_slopes, pseudo_inertia
from sim_gap.attribution.diagnose import diagnose
from sim_gap.effects.link import angles_of, tilt_gravity

GRAVITY = np.array([0.0, 0.0, -9.81])


def value(answer, effect: str, place: str, name: str):
    (cause,) = [cause for cause in answer.causes if cause.effect == effect]
    return cause.parameters[place][name]


@pytest.mark.long
def test_a_payload_and_friction_that_grows_with_the_load_it_adds():
    wrong = Wrong(payload=3.0, load=np.array([0.10, 0.0, 0.0]))
    train, other = (record(model(), wrong, seed=s, seconds=40, channels=("tau_motor",)) for s in (1, 2))
    answer = diagnose(model(), [train], [other])
    friction = value(answer, "friction.load", "joint_1", "coefficient")
    assert friction.low < 0.10 < friction.high
    assert friction.value == pytest.approx(0.10, rel=0.05)
    assert value(answer, "link.payload", "arm", "mass").value == pytest.approx(3.0, rel=0.03)


@pytest.mark.long
def test_a_sensors_gain_and_a_payload():
    wrong = Wrong(payload=2.0, gain=np.array([1.2, 1.0, 1.0]))
    train, other = (record(model(), wrong, seed=s, seconds=40) for s in (1, 2))
    answer = diagnose(model(), [train], [other])
    gain = value(answer, "torque.gain", "joint_1", "gain")
    assert gain.value == pytest.approx(1.2, abs=0.01)
    assert gain.low < 1.2 < gain.high
    assert value(answer, "link.payload", "arm", "mass").value == pytest.approx(2.0, rel=0.03)


@pytest.mark.long
@pytest.mark.parametrize("degrees", [90.0, 30.0, 150.0])
def test_a_base_that_is_turned_far(degrees):
    angles = np.radians(degrees) * np.array([0.8, -0.6])
    real = mujoco.MjModel.from_xml_string(THREE)
    real.opt.gravity[:] = tilt_gravity(GRAVITY, angles)
    train, other = (record(real, Wrong(coulomb=np.full(3, 0.3)), seed=s, seconds=40) for s in (1, 2))
    answer = diagnose(_upright(), [train], [other])
    assert answer.causes[0].effect == "base.tilt"
    found = np.array([value(answer, "base.tilt", "arm", f"angle_{k}").value for k in (1, 2)])
    between = np.degrees(
        np.arccos(np.clip(tilt_gravity(GRAVITY, found) @ tilt_gravity(GRAVITY, angles) / 9.81**2, -1, 1))
    )
    assert between < 0.5
    assert {c.effect for c in answer.causes if c.confidence > 0.5} == {"base.tilt", "friction.coulomb"}


def _upright() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(THREE)


def test_gravity_turns_as_the_rotation_vector_says():
    quarter = tilt_gravity(GRAVITY, np.array([np.pi / 2, 0.0]))
    np.testing.assert_allclose(quarter, [0.0, -9.81, 0.0], atol=1e-12)
    for angles in np.random.default_rng(0).uniform(-2.0, 2.0, (20, 2)):
        np.testing.assert_allclose(angles_of(GRAVITY, tilt_gravity(GRAVITY, angles)), angles, atol=1e-6)


def test_bodies_that_are_moved_or_added_can_exist():
    link = np.array([2.0, 0.1, 0.2, -0.3, 0.3, 0.01, 0.0, 0.3, 0.02, 0.2])
    assert np.linalg.eigvalsh(pseudo_inertia(link)).min() > 0.0
    far = move_mass(link, np.array([1.0, -2.0, 0.5]))
    body = pseudo_inertia(far)
    assert np.linalg.eigvalsh(body).min() > 0.0
    inertia = np.trace(body[:3, :3]) * np.eye(3) - body[:3, :3]
    np.testing.assert_allclose([body[3, 3], *body[:3, 3], *inertia[np.triu_indices(3)]], far)
    assert np.linalg.eigvalsh(pseudo_inertia(link + point_mass(1.5, np.array([0.2, 0.0, 0.3])))).min() > 0.0


def test_slopes_of_a_point_mass_are_those_of_differences():
    mass, moment, step = -0.7, np.array([0.1, -0.05, 0.2]), 1e-6
    slopes = point_slopes(mass, moment)
    for k, unit in enumerate(np.eye(4)):
        up, down = (point_mass(mass + s * step * unit[0], moment + s * step * unit[1:]) for s in (1, -1))
        np.testing.assert_allclose(slopes[:, k], (up - down) / (2 * step), atol=1e-6)


@pytest.mark.long
def test_a_body_of_the_model_that_the_arm_lacks_is_a_payload_of_negative_mass():
    loaded = mujoco.MjModel.from_xml_string(THREE)
    loaded.body_mass[-1], loaded.body_inertia[-1] = 2.5, [0.02, 0.02, 0.01]
    train, other = (record(_upright(), Wrong(), seed=s, seconds=40, channels=("tau_motor",)) for s in (1, 2))
    answer = diagnose(loaded, [train], [other])
    assert answer.causes[0].effect == "link.payload"
    assert value(answer, "link.payload", "arm", "mass").value == pytest.approx(-1.0, rel=0.05)
    assert any("the arm lacks" in note for note in answer.notes)


@pytest.mark.long
@pytest.mark.parametrize("groups", [(), ("loaded=b,c",)])
def test_a_payload_of_one_training_and_of_the_held_out_recording(groups):
    """Two recordings of three have it, the held-out one among them."""
    arm = Wrong(coulomb=np.full(3, 0.3))
    loaded = replace(arm, payload=1.2)
    made = [
        record(model(), wrong, seed=s, seconds=30, channels=("tau_motor",))
        for s, wrong in enumerate((arm, loaded, loaded))
    ]
    answer = diagnose(model(), made[:2], made[2:], labels=["a", "b", "c"], groups=groups)
    assert value(answer, "link.payload", "arm", "mass").value == pytest.approx(1.2, rel=0.05)
    assert "link.payload is present only in b and c" in answer.notes
    assert np.all(answer.heldout_after < 0.1)


@pytest.mark.long
def test_a_hum_above_the_band_is_no_true_model():
    def hums(seed: int):
        clean = record(model(), Wrong(), seed=seed, seconds=30, rate=250.0)
        wave = 0.5 * np.sin(2 * np.pi * 50.0 * clean.t)
        return replace(clean, motor_torque=clean.motor_torque + wave[:, None] * np.array([0.0, 1.0, 0.0]))

    answer = diagnose(model(), [hums(1)], [hums(2)]).to_json()
    assert answer["verdict"] == "unexplained"
    (band,) = [place for place in answer["where"] if place["regime"] == "band"]
    assert (band["joint"], band["channel"]) == ("joint_2", "tau_motor")
    assert band["hz"] == pytest.approx(50.0, abs=0.5)
    assert band["rms"] == pytest.approx(0.5 / np.sqrt(2), rel=0.1)


PLACE = np.array([0.10, 0.03, 0.12])
"""A body aside of the last joint's axis, which is y."""


def _turned(angle: float) -> tuple[float, float, float]:
    c, s = np.cos(angle), np.sin(angle)
    return float(c * PLACE[0] + s * PLACE[2]), float(PLACE[1]), float(c * PLACE[2] - s * PLACE[0])


def _with_body(angle: float | None, seed: int):
    """An arm with and without a body that is turned about the last joint's axis."""
    wrong = Wrong(coulomb=np.full(3, 0.3))
    wrong = wrong if angle is None else replace(wrong, payload=0.6, payload_at=_turned(angle))
    return record(model(), wrong, seed=seed, seconds=30, rate=50.0)


@pytest.mark.long
def test_a_body_that_is_mounted_in_another_way_on_the_held_out_recording():
    made = [_with_body(angle, seed) for seed, angle in enumerate((None, 0.0, 2.0))]
    answer = diagnose(model(), made[:2], made[2:], labels=["a", "b", "c"])
    assert answer.verdict == "explained"
    assert value(answer, "link.payload", "arm", "mass").value == pytest.approx(0.6, rel=0.03)
    (note,) = (note for note in answer.notes if "turned by" in note)
    degrees = float(note.partition("turned by ")[2].partition("°")[0])
    assert note.startswith("link.payload: in c ")
    assert degrees == pytest.approx(np.degrees(2.0), abs=2.0)
    assert answer.heldout_after.max() < 0.05


@pytest.mark.long
def test_loaded_recordings_judged_on_one_without_the_body():
    made = [_with_body(angle, seed) for seed, angle in enumerate((0.0, 0.0, None))]
    answer = diagnose(model(), made[:2], made[2:], labels=["a", "b", "c"])
    assert answer.verdict == "explained"
    assert value(answer, "link.payload", "arm", "mass").value == pytest.approx(0.6, rel=0.03)
    assert "link.payload is present only in a and b" in answer.notes
    assert "second half" in answer.heldout_is


@pytest.mark.long
def test_a_light_payload_is_not_taken_for_mass_moments_of_all_links():
    """Before it is fitted about itself it lacks its inertia, and three mass moments fit a little better."""
    wrong = Wrong(coulomb=np.array([0.2, 0.3, 0.1]), viscous=np.array([0.5, 0.2, 0.1]), payload=0.4)
    train, heldout = (record(model(), wrong, seed=seed, seconds=30, rate=50) for seed in (1, 2))
    answer = diagnose(model(), [train], [heldout])
    assert answer.verdict == "explained"
    assert answer.causes[0].effect == "link.payload"
    assert answer.causes[0].parameters["arm"]["mass"].value == pytest.approx(0.4, rel=0.03)


@pytest.mark.long
def test_two_causes_that_replace_one_another_are_not_both_called_minor():
    """At a shoulder whose load keeps its sign and size, Coulomb and load-dependent friction do the same."""
    arm = compile_model(Path(__file__).parents[2] / "models" / "ur10e.urdf")
    coulomb, load = np.array([8.0, 7.0, 5.0, 1.5, 1.2, 0.8]), np.array([0.0, 0.06, 0.0, 0.0, 0.0, 0.0])
    viscous, recordings = np.array([6.0, 5.0, 4.0, 1.0, 0.8, 0.5]), []
    for seed in (901, 902):
        random, t, data = np.random.default_rng(seed), np.arange(0.0, 40.0, 1 / 125), mujoco.MjData(arm)
        waves = random.uniform((0.1, 0.05, 0.0), (0.45, 0.35, 6.0), (arm.nv, 3, 3))
        q = np.stack([sum(a * np.sin(2 * np.pi * f * t + p) for a, f, p in joint) for joint in waves], axis=1)
        v = np.gradient(q, t, axis=0)
        a, torque = np.gradient(v, t, axis=0), np.zeros_like(q)
        for k in range(len(t)):
            data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
            mujoco.mj_inverse(arm, data)
            torque[k] = data.qfrc_inverse
        torque += (coulomb + load * np.abs(torque)) * np.tanh(v / 0.005) + viscous * v
        motor = torque + random.normal(0.0, 0.15, torque.shape)
        recordings.append(Recording(t=t, position=q, motor_torque=motor))
    answer = diagnose(arm, recordings[:1], recordings[1:])
    dry = [cause for cause in answer.causes if cause.effect in ("friction.coulomb", "friction.load")]
    assert "shoulder_lift_joint" in {joint for cause in dry for joint in cause.joints}


FIVE = """
<mujoco><option gravity="0 0 -9.81"/><worldbody>
<body pos="0 0 0.2"><joint name="joint_1" axis="0 0 1"/>
 <inertial pos="0 0 0.05" mass="4" diaginertia="0.02 0.02 0.02"/>
 <body pos="0 0 0.1"><joint name="joint_2" axis="0 1 0"/>
  <inertial pos="0.02 0 0.25" mass="5" diaginertia="0.08 0.08 0.01"/>
  <body pos="0 0 0.45"><joint name="joint_3" axis="0 1 0"/>
   <inertial pos="0.01 0 0.2" mass="3" diaginertia="0.04 0.04 0.01"/>
   <body pos="0 0 0.4"><joint name="joint_4" axis="0 1 0"/>
    <inertial pos="0 0.03 0.06" mass="1.5" diaginertia="0.004 0.004 0.002"/>
    <body pos="0 0 0.1"><joint name="joint_5" axis="0 0 1"/>
     <inertial pos="0.03 0 0.05" mass="0.8" diaginertia="0.001 0.001 0.001"/>
    </body></body></body></body></body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize("seed", [0, 3])
def test_a_zero_that_is_off_beside_a_wrong_mass_is_not_mass_moments_of_two_links(seed):
    random, zero = np.random.default_rng(seed), np.zeros(5)
    zero[3] = random.choice([-1.0, 1.0]) * random.uniform(0.15, 0.3)
    rubs = {"coulomb": random.uniform(0.2, 1.0, 5), "viscous": random.uniform(0.2, 1.0, 5)}
    wrong = Wrong(position_offset=zero, moved={2: tuple(random.normal(0.0, 0.02, 3))}, **rubs)
    train, other = (record(model(FIVE), wrong, seed=seed + s, channels=("tau_motor",)) for s in (0, 100))
    answer = diagnose(model(FIVE), [train], [other])
    assert value(answer, "position.offset", "joint_4", "offset").value == pytest.approx(zero[3], rel=0.2)
    (masses,) = [cause for cause in answer.causes if cause.effect == "link.mass_moment"]
    assert masses.joints == ("joint_3",)
