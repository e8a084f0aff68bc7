"""Models whose own friction is a placeholder, as in many published ones: the arm has less of it."""

import mujoco
import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis

LESS = Wrong(coulomb=np.array([0.2, 0.3, 0.1]), viscous=np.array([0.5, 0.2, 0.1]))
DAMPING = np.array([8.0, 5.0, 3.0])


def with_friction(nominal: mujoco.MjModel) -> mujoco.MjModel:
    np.reshape(nominal.dof_damping, (nominal.nv, -1))[:, 0] = DAMPING
    nominal.dof_frictionloss[:] = 1.0
    return nominal


def diagnosed(nominal: mujoco.MjModel, wrong: Wrong, channels: tuple[str, ...], real: mujoco.MjModel) -> Diagnosis:
    train, heldout = (
        record(real, wrong, seed=seed, seconds=seconds, rate=50.0, channels=channels)
        for seed, seconds in ((1, 30.0), (2, 20.0))
    )
    return diagnose(nominal, [train], [heldout])


@pytest.mark.sample(1)
@pytest.mark.parametrize("channels", [("tau_motor",), ("tau", "tau_motor")])
def test_friction_that_the_arm_lacks_is_an_effect_of_negative_size(channels):
    answer = diagnosed(with_friction(model()), LESS, channels, model())
    assert answer.verdict == "explained"
    assert [cause.effect for cause in answer.causes] == ["friction.viscous", "friction.coulomb"]
    for joint, name in enumerate(("joint_1", "joint_2", "joint_3")):
        viscous, coulomb = (cause.parameters[name] for cause in answer.causes)
        assert viscous["damping"].value == pytest.approx(LESS.viscous[joint] - DAMPING[joint], rel=0.02)
        assert coulomb["torque"].value == pytest.approx(LESS.coulomb[joint] - 1.0, rel=0.05)
    assert not answer.friction_compensation


CHAIN = 7


def chain() -> mujoco.MjModel:
    """Seven light links in a row: their motors might all be coupled to their neighbours'."""
    inertial = '<inertial pos="0 0.01 0.1" mass="1" diaginertia="0.01 0.01 0.01"/>'
    body = '<body pos="0 0 0.2"><joint name="j{0}" axis="{1}"/>' + inertial
    axes = ("0 0 1", "0 1 0")
    links = "".join(body.format(j + 1, axes[j % 2]) for j in range(CHAIN)) + "</body>" * CHAIN
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{links}</worldbody></mujoco>")


@pytest.mark.long
def test_the_search_goes_on_where_the_most_promising_terms_cannot_exist():
    """Couplings with negative friction lead on every joint: behind them stand damping and friction themselves."""
    nominal = chain()
    np.reshape(nominal.dof_damping, (CHAIN, -1))[:, 0] = 10.0
    nominal.dof_frictionloss[:] = 1.0
    answer = diagnosed(nominal, Wrong(), ("tau_motor",), chain())
    assert {cause.effect for cause in answer.causes} == {"friction.viscous", "friction.coulomb"}
    assert np.all(answer.heldout_after < 0.05 * answer.heldout_before)
