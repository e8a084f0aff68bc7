"""Chains with prismatic joints: a SCARA, an arm on a lift, a gantry; their forces are in N."""

import mujoco
import numpy as np
import pytest
from wrong_arms import THREE, Wrong, model, record

from sim_gap.api import diagnose

LINK = '<inertial pos="{x} 0 0.05" mass="{mass}" diaginertia="0.02 0.02 0.02"/>'


def chain(*joints: tuple[str, str, float]) -> str:
    """A body per joint (type, axis, mass), 0.3 m apart along x."""
    xml = "".join(
        f'<body name="link_{k}" pos="{0.3 * (k > 1)} 0 0.1"><joint name="joint_{k}" type="{kind}" axis="{axis}"/>'
        + LINK.format(x=0.15, mass=mass)
        for k, (kind, axis, mass) in enumerate(joints, start=1)
    )
    return f"<mujoco><worldbody>{xml}{'</body>' * len(joints)}</worldbody></mujoco>"


SCARA = chain(("hinge", "0 0 1", 4.0), ("hinge", "0 0 1", 3.0), ("slide", "0 0 1", 1.5), ("hinge", "0 0 1", 0.5))
GANTRY = chain(("slide", "1 0 0", 8.0), ("slide", "0 1 0", 5.0), ("slide", "0 0 1", 2.0))
BELOW = '<body name="lift"><joint name="lift" type="slide"/><geom size="0.1" mass="6"/><body name="link_1"'
LIFT = THREE.replace('<body name="link_1"', BELOW).replace("</worldbody>", "</body></worldbody>")


def by_joint(answer, effect: str, quantity: str) -> dict[str, tuple[float, str]]:
    causes = (cause for cause in answer.causes if cause.effect == effect)
    return {j: (v[quantity].value, v[quantity].unit) for cause in causes for j, v in cause.parameters.items()}


@pytest.mark.sample(2)
@pytest.mark.parametrize(("text", "slide"), [(SCARA, 2), (LIFT, 0), (GANTRY, 1)], ids=["SCARA", "lift", "gantry"])
def test_friction_of_a_prismatic_joint_is_in_newton(text: str, slide: int) -> None:
    sim = model(text)
    wrong = Wrong(coulomb=4.0 * np.eye(sim.nv)[slide], viscous=3.0 * np.eye(sim.nv)[slide])
    answer = diagnose(sim, [record(sim, wrong, 1)], [record(sim, wrong, 2)])
    assert answer.verdict == "explained"
    assert {cause.effect for cause in answer.causes} == {"friction.coulomb", "friction.viscous"}
    name = sim.joint(slide).name
    assert by_joint(answer, "friction.coulomb", "torque") == {name: (pytest.approx(4.0, abs=0.1), "N")}
    assert by_joint(answer, "friction.viscous", "damping") == {name: (pytest.approx(3.0, abs=0.2), "N·s/m")}
    assert any(name in note and "prismatic" in note for note in answer.notes)


@pytest.mark.sample(1)
@pytest.mark.parametrize("text", [SCARA, LIFT, GANTRY], ids=["SCARA", "lift", "gantry"])
def test_a_payload_is_weighed_by_a_prismatic_joint_too(text: str) -> None:
    sim = model(text)
    wrong = Wrong(payload=0.8, payload_at=(0.05, 0.02, 0.1))
    answer = diagnose(sim, [record(sim, wrong, 3)], [record(sim, wrong, 4)])
    assert answer.causes[0].effect == "link.payload", answer.causes
    mass = answer.causes[0].parameters["arm"]["mass"]
    assert (mass.value, mass.unit) == (pytest.approx(0.8, rel=0.05), "kg")


@pytest.mark.sample(1)
@pytest.mark.parametrize("text", [SCARA, LIFT, GANTRY], ids=["SCARA", "lift", "gantry"])
def test_a_sound_arm_has_no_gap(text: str) -> None:
    sim = model(text)
    answer = diagnose(sim, [record(sim, Wrong(), 5)], [record(sim, Wrong(), 6)])
    assert (answer.verdict, answer.checks) == ("no_gap", ())


def test_slides_of_a_hand_are_not_the_arms() -> None:
    finger = '<body name="f{0}"><joint name="s{0}" type="slide" axis="0 {0} 0"/><geom size="0.01" mass="0.05"/></body>'
    fingers = finger.format(1) + finger.format(-1)
    sim = mujoco.MjModel.from_xml_string(THREE.replace("</body></body></body>", f"{fingers}</body></body></body>"))
    three = model()
    answer = diagnose(sim, [record(three, Wrong(), 7)], [record(three, Wrong(), 8)])
    assert answer.names == ("joint_1", "joint_2", "joint_3")
