"""Arms without torque sensors: torque constants of all drives from motor torque alone."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from wrong_arms import THREE, Wrong, model, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.better_model.export import write_model

CONSTANTS = np.array([1.24, 0.8, 1.3])
DRIVES = Wrong(
    motor_gain=CONSTANTS,
    coulomb=np.array([0.6, 0.5, 0.3]),
    viscous=np.array([0.3, 0.2, 0.1]),
    load=np.array([0.05, 0.0, 0.08]),
    rotor=np.array([0.2, 0.1, 0.05]),
)
JOINTS = ("joint_1", "joint_2", "joint_3")
MOTORS = "".join(f'<motor joint="{joint}" gear="1"/>' for joint in JOINTS)


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "sim.xml"
    path.write_text(THREE.replace("</mujoco>", f"<actuator>{MOTORS}</actuator></mujoco>"))
    return path


@pytest.fixture(scope="module")
def answer(model_file) -> Diagnosis:
    made = [record(model(), DRIVES, seed, 40.0, 50.0, channels=("tau_motor",)) for seed in (1, 2)]
    return diagnose(str(model_file), made[:1], made[1:])


def values(answer: Diagnosis, effect: str, name: str) -> list:
    causes = [cause for cause in (*answer.causes, *answer.minor) if cause.effect == effect]
    found = {joint: each[name] for cause in causes for joint, each in cause.parameters.items()}
    return [found.get(joint) for joint in JOINTS]


def test_constants_that_are_all_off_are_not_taken_for_other_masses(answer):
    found = values(answer, "actuator.gain", "gain")
    assert [each.value for each in found] == pytest.approx(CONSTANTS, rel=0.01)
    assert all(each.low < true < each.high for each, true in zip(found, CONSTANTS, strict=True))
    assert not [cause for cause in answer.causes if cause.effect.startswith("link.")]


@pytest.mark.parametrize(
    ("effect", "name", "true"),
    [
        ("friction.coulomb", "torque", DRIVES.coulomb),
        ("friction.viscous", "damping", DRIVES.viscous),
        ("actuator.rotor_inertia", "inertia", DRIVES.rotor),
    ],
)
def test_friction_and_rotors_are_told_in_true_newton_metres(answer, effect, name, true):
    found = values(answer, effect, name)
    assert [each.value for each in found] == pytest.approx(true, rel=0.1)
    assert all(each.low < value < each.high for each, value in zip(found, true, strict=True))
    assert all(each.high - each.low < 4.0 * value for each, value in zip(found, true, strict=True))


def test_what_masses_and_constants_have_in_common_is_said_to_be_unknown(answer):
    assert any("the common scale of masses and torque constants" in note for note in answer.notes)
    for each in values(answer, "actuator.gain", "gain"):
        assert each.high - each.low > 2 * 0.015 * each.value


def test_the_written_model_has_constants_friction_and_rotors(answer, tmp_path):
    inside = answer.internals
    write_model(inside.model, inside.estimate, tmp_path / "closed.xml")
    closed = mujoco.MjModel.from_xml_path(str(tmp_path / "closed.xml"))
    assert closed.actuator_gear[:, 0] == pytest.approx(CONSTANTS, rel=0.01)
    assert closed.dof_armature == pytest.approx(DRIVES.rotor, rel=0.1)
    assert closed.dof_frictionloss == pytest.approx(DRIVES.coulomb, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize(("gains", "masses"), [([0.79, 0.81, 0.8], 1.0), ([1.0, 1.0, 1.0], 1.25)])
def test_constants_or_masses_that_are_all_off_alike_may_be_either_and_the_answer_says_so(model_file, gains, masses):
    spec = mujoco.MjSpec.from_file(str(model_file))
    spec.compile()
    for body in spec.bodies[1:]:
        body.mass, body.fullinertia, body.inertia = masses * body.mass, masses * body.fullinertia, masses * body.inertia
    sim = model_file.with_name(f"{masses}.xml")
    sim.write_text(spec.to_xml())
    alike = replace(DRIVES, motor_gain=np.array(gains))
    made = [record(model(), alike, seed, 40.0, 50.0, channels=("tau_motor",)) for seed in (1, 2)]
    answer = diagnose(str(sim), made[:1], made[1:])
    either = {"actuator.gain", "link.mass_moment"}
    (found,) = [cause for cause in answer.causes if cause.effect in either]
    assert found.confounded_with[0] in either - {found.effect}
    assert "known payload" in found.separate_by
    assert answer.verdict == "ambiguous"
    assert any("only the products of masses and torque constants" in note for note in answer.notes)
