"""Draws of parameters from recordings with torque: they scatter as the estimate says, and stay physical."""

import csv
import json
import sys
import types

import numpy as np
import pytest
from wrong_arms import THREE, Wrong, model, record

from armlink import cli
from armlink.errors import BadInput
from armlink.recording.files import save_recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.better_model.training_files import drawn_parameters, write_motor_entries
from sim_gap.search.term import Term

TRUE = np.array([0.6, 0.4, 0.02])


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """The nominal model's file, a recording of an arm with friction, and the answer to it."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.xml").write_text(THREE)
    wrong = Wrong(coulomb=TRUE, viscous=np.array([0.0, 0.5, 0.0]))
    made = record(model(), wrong, seed=3, seconds=30, noise=0.02, channels=("tau_motor",))
    save_recording(made, folder / "run.csv")
    return folder, diagnose(folder / "arm.xml", [made])


@pytest.mark.long
def test_draws_scatter_about_the_estimate_by_its_intervals(arm):
    answer = arm[1]
    estimate = answer.internals.estimate
    rows = drawn_parameters(estimate, answer.names, 2000)
    assert any(term.effect == "friction.coulomb" for term in estimate.terms)
    for term in estimate.terms:
        for name, value in estimate.parameters(term).items():
            drawn = np.array([row[f"{answer.names[term.place]}.{term.effect}.{name}"] for row in rows])
            half = (value.high - value.low) / 2
            if value.value < 1.5 * half:
                continue  # cut off at zero
            low, middle, high = np.quantile(drawn, [0.025, 0.5, 0.975])
            np.testing.assert_allclose([low, middle, high], [value.low, value.value, value.high], atol=0.15 * half)
    drawn = np.array([row["joint_1.friction.coulomb.torque"] for row in rows])
    assert drawn.min() < TRUE[0] < drawn.max()


def test_correlations_are_kept(arm):
    """Coulomb and viscous friction of a joint make up for one another."""
    estimate = arm[1].internals.estimate
    rows = drawn_parameters(estimate, arm[1].names, 4000)
    pair = [[row[f"joint_2.friction.{name}"] for row in rows] for name in ("coulomb.torque", "viscous.damping")]
    at = [int(estimate.equations.at[Term(f"friction.{name}", 1)][0]) for name in ("coulomb", "viscous")]
    covariance = estimate.covariance[np.ix_(at, at)]
    told = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    assert told < -0.15
    assert np.corrcoef(pair)[0, 1] == pytest.approx(told, abs=0.05)


def test_no_draw_is_what_no_arm_has(arm):
    rows = drawn_parameters(arm[1].internals.estimate, arm[1].names, 2000)
    friction = [value for row in rows for key, value in row.items() if "friction" in key]
    assert min(friction) >= 0.0


def test_the_command_writes_draws_and_shows_intervals(arm, capsys):
    folder = arm[0]
    run = ["gap", "diagnose", "--sim", str(folder / "arm.xml"), "--train", str(folder / "run.csv"), "--json", "-"]
    more = ["--samples", "5", "--out-samples", str(folder / "draws.csv"), "--out-actuators", str(folder / "motors.py")]
    assert cli.run([*run, *more]) == 0
    assert "BuiltinMotorActuatorCfg" in (folder / "motors.py").read_text()
    said = capsys.readouterr()
    with (folder / "draws.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5
    assert all(float(value) == float(value) for row in rows for value in row.values())
    coulomb = json.loads(said.out)["causes"][0]["parameters"]["joint_1"]["torque"]
    assert "friction.coulomb" in said.err
    assert f"{coulomb['value']:.4g}" in said.err
    assert f"{coulomb['ci95'][0]:.3g} to {coulomb['ci95'][1]:.3g}" in said.err


def test_actuator_entries_of_motors_hold_the_corrected_model(arm, tmp_path, monkeypatch):
    """The frameworks' names stand in here: they need a GPU and gigabytes."""
    for package, name, entry in (
        ("isaaclab", "isaaclab.actuators", "DelayedPDActuatorCfg"),
        ("mjlab", "mjlab.actuator", "BuiltinMotorActuatorCfg"),
    ):
        module = types.ModuleType(name)
        setattr(module, entry, dict)
        monkeypatch.setitem(sys.modules, package, types.ModuleType(package))
        monkeypatch.setitem(sys.modules, name, module)
    inside = arm[1].internals
    write_motor_entries(inside.model, inside.estimate, tmp_path / "motors.py")
    made: dict = {}
    exec((tmp_path / "motors.py").read_text(), made)
    isaac, mjlab = made["isaac_lab"](), made["mjlab"]()
    for j, name in enumerate(arm[1].names):
        (other,) = [entry for entry in mjlab if entry["target_names_expr"] == (name,)]
        assert isaac[name]["stiffness"] is None
        assert "stiffness" not in other
        assert isaac[name]["friction"] == other["frictionloss"] == pytest.approx(TRUE[j], abs=0.1)
        assert isaac[name]["armature"] == other["armature"]
        assert (isaac[name]["min_delay"], isaac[name]["max_delay"]) == (0, 0)
    assert isaac["joint_2"]["viscous_friction"] == mjlab[1]["viscous_damping"] == pytest.approx(0.5, abs=0.1)
    with pytest.raises(BadInput, match=r"ends in \.py"):
        write_motor_entries(inside.model, inside.estimate, tmp_path / "motors.yaml")
