import json

import mujoco
import numpy as np
import pytest

from armlink.recording.files import load_recording
from sim_gap.blind.cases import make_case
from sim_gap.blind.effects.controller import DRAWS, OF_THE_ARM
from sim_gap.blind.recipe import CaseRecipe, servo_recipes
from sim_gap.blind.score import score_positions
from sim_gap.position_gap.training.replay import Simulated, replay_rms


def test_every_effect_comes_in_turn() -> None:
    drawn = servo_recipes(3, 80)
    every = {(), *((effect,) for effect in (*DRAWS, *OF_THE_ARM))}
    assert {r.effects for r in drawn if r.controller_known} == every
    undecidable = {("controller.stiffness",), ("friction.viscous",)}
    assert not any(r.effects in undecidable for r in drawn if not r.controller_known)
    assert drawn == servo_recipes(3, 80)


@pytest.mark.long
def test_the_arm_without_an_effect_moves_as_its_model_does_in_mujoco(tmp_path) -> None:
    """Plant and servo against MuJoCo's own position actuators; with a lower gain both part."""
    for k, effects in enumerate(((), ("controller.stiffness",))):
        recipe = CaseRecipe(f"case_{k:04d}", effects, (9, 1 + k), controller_known=True)
        make_case(recipe, tmp_path / "cases", tmp_path / "labels", 4.0, 4.0)
    rms = {}
    for case in ("case_0000", "case_0001"):
        folder = tmp_path / "cases" / case
        model = mujoco.MjModel.from_xml_path(str(folder / "sim.xml"))
        recording = load_recording(folder / "heldout.csv")
        assert recording.torque is None
        moved = np.sqrt(np.mean((recording.position - recording.position_command) ** 2, axis=0))
        rms[case] = replay_rms(Simulated(model, tuple(range(model.njnt))), [recording]) / moved
    label = json.loads((tmp_path / "labels" / "case_0001.json").read_text())
    assert label["effects"][0]["effect"] == "controller.stiffness"
    assert rms["case_0000"].max() < 0.1
    assert rms["case_0001"].max() > 2.0 * rms["case_0000"].max()


def test_score_counts_confounded_answers_and_false_ones() -> None:
    def label(case: str, effect: str) -> dict:
        return {
            "case": case,
            "kind": "single",
            "effects": [
                {
                    "effect": effect,
                    "joints": ["joint_1"],
                    "parameters": {},
                    "axis": None,
                    "implied": [],
                    "undecided": "",
                    "confused_with": [],
                }
            ],
            "gap": {"falls": [], "without": {"q": [0.001]}},
        }

    def answer(effect: str, confidence: float, rivals: list[str]) -> dict:
        cause = {
            "effect": effect,
            "joints": ["joint_1"],
            "parameters": {},
            "confidence": confidence,
            "confounded_with": rivals,
            "gap_before": 0.02,
            "gap_after": 0.01,
        }
        return {"verdict": "explained", "causes": [cause], "gap": {"heldout": {"before": [0.02], "after": [0.01]}}}

    labels = {name: label(name, "controller.dead_zone") for name in ("a", "b")}
    answers = {"a": answer("transmission.backlash", 0.7, ["controller.dead_zone"]), "b": answer("base.tilt", 0.9, [])}
    result = score_positions(answers, labels)
    assert result["named_where_tellable"] == 0.5
    assert result["false_confident"] == 0.5
    assert result["meets"] == {"named_where_tellable": False, "false_confident": False}
    labels = {f"case_{k}": label(f"case_{k}", "controller.dead_zone") for k in range(20)}
    named = ["controller.dead_zone"] * 17 + ["base.tilt"] * 3
    result = score_positions(
        {case: answer(effect, 0.5, []) for case, effect in zip(labels, named, strict=True)}, labels
    )
    assert result["named_where_tellable"] == 0.85
    assert result["meets"] == {"named_where_tellable": True, "false_confident": True}
