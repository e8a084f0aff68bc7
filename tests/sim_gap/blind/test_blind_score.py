"""Sealing and scoring of the blind check, on answers and labels made by hand."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from armlink.errors import BadInput, Refused
from sim_gap.blind.bench import MANIFEST, open_labels, run_bench, seal, seal_answers, verify
from sim_gap.blind.cases import label_of
from sim_gap.blind.recipe import draw, recipes
from sim_gap.blind.score import answer_name, judge, score


def truth(effect: str, joint: str = "joint_2", undecided: str = "", **parameters: float) -> dict[str, Any]:
    return {
        "effect": effect,
        "joints": [joint],
        "parameters": {joint: parameters or {"torque": 2.0}},
        "axis": [0.0, 0.0, 1.0],
        "implied": [],
        "undecided": undecided,
        "confused_with": [],
    }


def label(*effects: dict[str, Any], case: str = "case_0000") -> dict[str, Any]:
    kind = ("none", "single", "two")[len(effects)]
    gap = {
        "with": {"tau": [0.1, 0.1], "tau_motor": [0.1, 1.0]},
        "without": {"tau": [0.1, 0.1], "tau_motor": [0.1, 0.1]},
        "falls": [{"channel": "tau_motor", "joint": "joint_2"}] * len(effects),
    }
    return {"case": case, "kind": kind, "n": 2, "effects": list(effects), "gap": gap}


def cause(
    effect: str, confidence: float = 0.99, fall: float = 0.9, rivals: tuple[str, ...] = (), **by_joint: Any
) -> dict[str, Any]:
    values = by_joint or {"joint_2": {"torque": 2.0}}
    return {
        "effect": effect,
        "joints": list(values),
        "parameters": {
            joint: {name: {"value": x, "ci95": [x - 0.1, x + 0.1]} for name, x in named.items()}
            for joint, named in values.items()
        },
        "gap_before": 1.0,
        "gap_after": 1.0 - fall,
        "confidence": confidence,
        "confounded_with": list(rivals),
    }


def answer(*causes: dict[str, Any], verdict: str = "explained", after: float = 0.1) -> dict[str, Any]:
    return {
        "verdict": verdict,
        "causes": list(causes),
        "gap": {"heldout": {"before": [0.1, 1.0], "after": [0.1, after]}},
    }


def test_right_cause_first() -> None:
    judged = judge(answer(cause("friction.coulomb")), label(truth("friction.coulomb")))
    assert judged.first_right
    assert judged.named
    assert not judged.blamed
    assert judged.joints == (1, 0, 0)
    assert [e.relative for e in judged.errors] == [0.0]
    assert judged.errors[0].inside
    assert judged.shrink == pytest.approx(0.9)
    assert judged.shrink_true == pytest.approx(0.9)


def test_true_cause_as_rival_is_named_but_not_first() -> None:
    judged = judge(
        answer(cause("friction.viscous", 0.6, rivals=("friction.coulomb",))), label(truth("friction.coulomb"))
    )
    assert judged.named
    assert not judged.first_right
    assert not judged.blamed


def test_extra_cause_is_blamed_only_when_confident_and_large() -> None:
    case = label(truth("friction.coulomb"))
    right = cause("friction.coulomb")
    assert judge(answer(right, cause("torque.gain", 0.9, 0.5)), case).blamed == ("torque.gain",)
    assert judge(answer(right, cause("torque.gain", 0.7, 0.5)), case).blamed == ()
    small = cause("torque.offset", 0.99, 0.05)
    assert judge(answer(right, small), case).blamed == ()  # a small true imperfection, listed last
    assert judge(answer(small, right), case).blamed == ("torque.offset",)


def test_implied_effect_may_stand_first() -> None:
    case = label({**truth("friction.stribeck", breakaway=1.0, velocity=0.1), "implied": ["friction.coulomb"]})
    judged = judge(
        answer(cause("friction.coulomb"), cause("friction.stribeck", joint_2={"breakaway": 1.1, "velocity": 0.1})), case
    )
    assert judged.first_right
    assert not judged.blamed
    assert [e.relative for e in judged.errors] == pytest.approx([0.1, 0.0])


def test_joint_that_is_small_beside_the_largest_does_not_count() -> None:
    two = cause("friction.coulomb", joint_1={"torque": 0.02}, joint_2={"torque": 1.9})
    assert judge(answer(two), label(truth("friction.coulomb"))).joints[1] == 0
    two = cause("friction.coulomb", joint_1={"torque": 1.0}, joint_2={"torque": 1.9})
    judged = judge(answer(two), label(truth("friction.coulomb")))
    assert judged.joints == (1, 1, 0)


def test_gain_errs_by_its_distance_from_one() -> None:
    judged = judge(answer(cause("torque.gain", joint_2={"gain": 1.09})), label(truth("torque.gain", gain=1.10)))
    assert [e.relative for e in judged.errors] == pytest.approx([0.1])


def test_joints_of_an_effect_that_is_not_found_are_missed_and_of_one_named_as_rival_are_not() -> None:
    nothing = judge(answer(), label(truth("friction.coulomb")))
    assert nothing.joints == (0, 0, 1)
    rival = judge(answer(cause("actuator.lag", rivals=("actuator.delay",))), label(truth("actuator.delay")))
    assert rival.joints == (1, 0, 0)


def test_inertia_errs_about_the_joints_axis() -> None:
    true = truth("link.inertia", xx=0.5, xy=0.0, xz=0.0, yy=0.5, yz=0.0, zz=1.0)
    judged = judge(answer(cause("link.inertia", joint_2={"xx": 9.0, "zz": 0.9, "yz": 3.0})), label(true))
    assert [e.relative for e in judged.errors] == pytest.approx([0.1])


def test_withheld_effect_must_not_be_replaced() -> None:
    case = label(truth("friction.coulomb"))
    assert judge(answer(verdict="unexplained"), case, "friction.coulomb").blamed == ()
    assert judge(answer(cause("friction.stribeck")), case, "friction.coulomb").blamed == ("friction.stribeck",)
    assert judge(answer(cause("friction.stribeck", 0.5)), case, "friction.coulomb").blamed == ()


def test_score_counts_shares() -> None:
    coulomb, nothing = label(truth("friction.coulomb"), case="a"), label(case="b")
    both = label(truth("friction.coulomb"), truth("torque.offset", offset=1.0), case="c")
    slow = label(truth("actuator.lag", undecided="needs a chirp", time=0.01), case="d")
    labels = {x["case"]: x for x in (coulomb, nothing, both, slow)}
    answers = {
        "a": answer(cause("friction.coulomb", joint_2={"torque": 2.2})),
        "b": answer(verdict="no_gap"),
        "c": answer(cause("friction.coulomb")),
        "d": answer(cause("actuator.delay", 0.5, rivals=("actuator.lag",)), verdict="ambiguous"),
        answer_name("a", "friction.coulomb"): answer(cause("friction.viscous")),
    }
    result = score(answers, labels)
    judged = result["label_withheld"]
    assert judged["cases"] == 4
    assert judged["first_right_where_tellable"] == 1.0
    assert judged["first_right"] == 0.5
    assert judged["first_or_confounded"] == 1.0
    assert judged["no_effect"] == {"cases": 1, "false_alarms": 0.0}
    assert judged["two"] == {"cases": 1, "both_found": 0.0}
    assert (judged["joints"]["precision"], judged["joints"]["recall"]) == (
        1.0,
        0.75,
    )  # of c the offset's joint is missed
    assert judged["joints"]["f1"] == pytest.approx(6 / 7)
    assert result["effect_withheld"]["false_blame"] == 1.0
    assert result["confusion"] == {
        "actuator.lag": {"actuator.delay": 1},
        "friction.coulomb": {"friction.coulomb": 1},
        "none": {"no_gap": 1},
    }
    assert [line["count"] for line in result["calibration"]] == [1, 2]
    assert not result["meets"]["false_blame"]
    json.dumps(result)


def write_answer(folder: Path, name: str, given: dict[str, Any]) -> None:
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(given))


def test_labels_stay_shut_until_the_answers_are_sealed(tmp_path: Path) -> None:
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels/a.json").write_text(json.dumps(label(case="a")))
    write_answer(tmp_path / "answers", "a", answer(verdict="no_gap"))
    with pytest.raises(Refused, match="not sealed"):
        open_labels(tmp_path / "answers", tmp_path / "labels")
    digest = seal(tmp_path / "answers")
    answers, labels = open_labels(tmp_path / "answers", tmp_path / "labels", digest)
    assert list(answers) == list(labels) == ["a"]


def test_a_broken_seal_is_refused(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_answer(tmp_path, name, answer())
    digest = seal(tmp_path)
    write_answer(tmp_path, "c", answer())
    with pytest.raises(Refused, match=r"c\.json: was added"):
        verify(tmp_path, digest)
    (tmp_path / "c.json").unlink()
    with pytest.raises(Refused, match="not the manifest"):
        verify(tmp_path, "0" * 64)
    kept = (tmp_path / "a.json").read_text()
    (tmp_path / "a.json").write_text(kept + " ")
    with pytest.raises(Refused, match=r"a\.json: was changed"):
        verify(tmp_path, digest)
    (tmp_path / "a.json").write_text(kept)
    (tmp_path / "b.json").unlink()
    with pytest.raises(Refused, match=r"b\.json: was removed"):
        verify(tmp_path, digest)
    assert (tmp_path / MANIFEST).exists()


def fail(folder: Path, withheld: Any) -> dict[str, Any]:
    with (folder.parent / "tried").open("a") as stream:
        stream.write(folder.name + "\n")
    raise ZeroDivisionError


@pytest.mark.long
def test_a_diagnosis_that_breaks_ends_the_bench_and_says_where(tmp_path: Path) -> None:
    jobs = {f"case_{k:04d}": partial(fail, tmp_path / f"case_{k:04d}", []) for k in range(1000)}
    for workers in (1, 2):
        with pytest.raises(ZeroDivisionError) as raised:
            seal_answers(tmp_path / f"answers_{workers}", jobs, workers)
        assert workers == 2 or "case_0000" in raised.value.__notes__[0]
    assert len((tmp_path / "tried").read_text().splitlines()) < 1 + len(jobs)


def test_bench_runs_from_cases_to_score(tmp_path: Path) -> None:
    seen = []

    def diagnose(folder: Path, withheld: Any) -> dict[str, Any]:
        seen.append(({path.name for path in folder.iterdir()}, withheld))
        assert not (tmp_path / "bench/answers" / MANIFEST).exists()
        if len(seen) == 1:
            raise BadInput("cannot be used")
        return answer(verdict="no_gap")

    result = run_bench(diagnose, tmp_path / "bench", seed=4, cases=2, workers=1, lengths=(8.0, 5.0))
    assert result["label_withheld"]["cases"] == 2
    assert len(seen) == 2 + result["effect_withheld"]["cases"]
    assert seen[0] == ({"sim.xml", "train.csv", "heldout.csv"}, [])
    assert len(result["sealed"]) == 64
    with pytest.raises(BadInput, match="earlier check"):
        run_bench(diagnose, tmp_path / "bench", cases=1)


def test_many_effects_at_once_are_different_and_can_be_told_apart():
    wanted = recipes(5, 3, (5, 8))
    assert all(recipe.kind == "several" and 5 <= recipe.several <= 8 for recipe in wanted)
    drawing = draw(wanted[0], 60.0, 20.0)
    assert drawing is not None
    effects = [each.effect for each in drawing.drawn]
    assert len(effects) == len(set(effects)) == wanted[0].several
    told = label_of(drawing, {})
    assert told["kind"] == "several"
    assert [each["effect"] for each in told["effects"]] == effects


def test_a_number_of_effects_that_no_arm_has_is_refused(tmp_path):
    with pytest.raises(BadInput, match="5-8"):
        run_bench(lambda *_: {}, tmp_path, effects="8-5")
