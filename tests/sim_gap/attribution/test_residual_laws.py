"""Laws outside the library: what no effect takes is told as a law of the right quantity, with the right torque."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.residual_laws import as_effects
from sim_gap.better_model.forward_effects import Effects
from sim_gap.report.figures import law_figure

FRICTION = [f"friction.{name}" for name in ("coulomb", "viscous", "stribeck", "asymmetric", "load")]
WARM_NM, WARM_S = 1.5, 12.0


@pytest.fixture(scope="module")
def answer():
    """Joint 1 has Coulomb friction that the library lacks; joint 2's gets less as it warms up."""
    made = []
    for seed in (1, 2):
        recording = record(model(), Wrong(coulomb=np.array([0.8, 0.0, 0.0])), seed, seconds=40.0, rate=50.0)
        speed = np.gradient(recording.position[:, 1], recording.t)
        motor = recording.motor_torque.copy()
        motor[:, 1] += WARM_NM * np.exp(-recording.t / WARM_S) * np.tanh(speed / 0.002)
        made.append(replace(recording, motor_torque=motor))
    return diagnose(model(), made[:1], made[1:], withhold=[*FRICTION, "transmission.coupling"])


def test_laws_are_named_after_quantity_and_joint(answer):
    found = {law.joint: law for law in answer.laws}
    assert (found[1].quantity, found[1].directed) == ("time", True)
    assert found[0].directed
    assert all(law.after < 0.5 * law.before for law in found.values())
    told = [cause for cause in answer.to_json()["causes"] if cause["effect"] == "law.time"]
    assert told[0]["joints"] == ["joint_2"]
    assert told[0]["confidence"] <= 0.5
    assert answer.verdict == "unexplained"


def test_the_torque_of_a_law_is_the_true_one(answer):
    law = next(law for law in answer.laws if law.joint == 1)
    inside = slice(1, -1)
    assert law.torque[inside] == pytest.approx(WARM_NM * np.exp(-law.at[inside] / WARM_S), abs=0.15)
    assert law_figure(answer, law).data


def test_the_band_of_a_law_is_narrow_beside_it(answer):
    law = next(law for law in answer.laws if law.joint == 1)
    assert (law.band > 0.0).all()
    assert law.band.max() < 0.25 * np.ptp(law.torque)


def test_the_exported_module_applies_laws():
    arm = model()
    law = ("law.velocity", "joint_2", {"at": [0.0, 1.0], "torque": [0.5, 1.5], "directed": True})
    effects = Effects(arm, (law,), ("joint_1", "joint_2", "joint_3"))
    still = np.zeros(3)
    assert effects.resist
    assert effects.resistance(still, np.array([0.0, -0.5, 0.0]), still, still)[1] == pytest.approx([0.0, -1.0, 0.0])


def test_laws_are_written_as_the_module_reads_them(answer):
    for name, joint, law in as_effects(answer.laws, answer.names):
        assert name.startswith("law.")
        assert joint in answer.names
        assert len(law["at"]) == len(law["torque"])


@pytest.mark.long
def test_a_motor_that_sticks_in_creep_follows_no_law():
    """There it may hold any torque up to its friction: that it holds less is nothing unknown."""
    made = []
    for seed in (1, 2):
        recording = record(model(), Wrong(coulomb=6.0), seed, seconds=40.0, rate=50.0)
        speed = np.gradient(recording.position, recording.t, axis=0)
        stuck = -6.0 * np.sign(speed) * (np.abs(speed) < 0.03)
        made.append(replace(recording, motor_torque=recording.motor_torque + stuck))
    answer = diagnose(model(), made[:1], made[1:])
    assert [cause.effect for cause in answer.causes] == ["friction.coulomb"]
    assert not answer.laws
