"""The bench of real arms: what is known is read after the seal, and judges answers made by hand."""

import numpy as np
import pytest
from wrong_arms import THREE, Wrong, model, record

from armlink.arm_file import read_yaml
from armlink.errors import BadInput
from sim_gap.blind.real_recordings import KNOWN, judge_real, run_real, score_real
from sim_gap.effects.registry import library_without
from sim_gap.position_gap.parameters import EFFECTS

CASE = {
    "case": "arm",
    "sim": "sim.xml",
    "train": ["a.csv"],
    "first": ["friction.coulomb"],
    "has": ["friction.coulomb", "link.payload"],
    "open": ["friction.stribeck"],
    "must": {"link.payload": {"mass": [2.9, 3.2]}},
    "withhold": ["link.payload"],
}


def cause(effect: str, confidence: float = 0.9, **values: float) -> dict[str, object]:
    parameters = {"arm": {name: {"value": value} for name, value in values.items()}}
    return {"effect": effect, "confidence": confidence, "parameters": parameters}


def answer(*causes: dict[str, object], verdict: str = "explained") -> dict[str, object]:
    return {"verdict": verdict, "causes": list(causes)}


def test_what_is_known_is_right_and_what_nobody_knows_does_not_count():
    row = judge_real(
        answer(cause("friction.coulomb"), cause("friction.stribeck"), cause("link.payload", mass=3.0)), CASE
    )
    assert row["first_right"]
    assert not row["false"]
    assert not row["lacking"]


def test_a_parameter_out_of_its_bounds_is_not_named():
    assert judge_real(answer(cause("friction.coulomb"), cause("link.payload", mass=3.4)), CASE)["lacking"]


def test_a_withheld_effect_is_false_and_only_if_it_is_confident():
    sure, hint = (judge_real(answer(cause("torque.gain", c)), CASE, "link.payload") for c in (0.9, 0.5))
    assert sure["false"] == ["torque.gain"]
    assert not hint["false"]


def test_shares_over_all_answers():
    refused = {"case": "servo", "sim": "s.xml", "train": ["b.csv"], "refused": True}
    answers = {
        "arm": answer(cause("friction.coulomb"), cause("link.payload", mass=3.0)),
        "arm--without--link.payload": answer(cause("torque.gain"), verdict="ambiguous"),
        "servo": {**answer(verdict="unexplained"), "refused": "no torque channel"},
    }
    score = score_real(answers, [CASE, refused])
    assert (score["right_first"], score["named"], score["refused_as_known"]) == (1.0, 1.0, 1.0)
    assert score["false_confident"] == 0.5
    assert not score["meets"]


def test_the_arms_that_are_published_name_effects_of_the_library():
    library = {*library_without(()), *EFFECTS}
    for case in read_yaml(KNOWN):
        named = {*case.get("first", ()), *case.get("has", ()), *case.get("open", ()), *case.get("withhold", ())}
        assert named <= library, case["case"]
        assert {*case.get("must", ())} <= {*case.get("has", ())}


def test_a_folder_without_recordings_is_refused(tmp_path):
    with pytest.raises(BadInput, match="holds none of the recordings"):
        run_real(tmp_path, tmp_path / "out")


@pytest.mark.long
def test_recordings_are_diagnosed_and_sealed(tmp_path):
    (tmp_path / "sim.xml").write_text(THREE)
    made = record(model(), Wrong(coulomb=np.full(3, 0.5)), seconds=20.0, rate=50.0)
    header = ",".join(["t", *(f"{name}_{j + 1}" for name in ("q", "tau_motor") for j in range(3))])
    table = np.column_stack([made.t, made.position, made.motor_torque])
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header=header, comments="")
    known = tmp_path / "known.yaml"
    known.write_text(
        "- {case: arm, sim: sim.xml, train: [a.csv], share: 0.6, first: [friction.coulomb],"
        " has: [friction.coulomb, friction.viscous], withhold: [friction.coulomb]}"
    )
    score = run_real(tmp_path, tmp_path / "out", known)
    assert score["right_first"] == 1.0
    assert score["sealed"]
    assert not score["missing"]
    assert {row["withheld"] for row in score["cases"]} == {None, "friction.coulomb"}
