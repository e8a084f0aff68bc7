"""The referee: scores worked out by hand, the seal, and a small round with two adapters, one of them the page's."""

import json
import math
import re
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))
from referee import contest, draw, interface, measure, mjcf, mujoco_plant, page, rounds, score, seal  # noqa: E402
from referee.interface import Answer, Cause, Parameter, answer_from_json  # noqa: E402

from armlink.effect_catalogue import CATALOGUE  # noqa: E402
from sim_gap.position_gap.parameters import EFFECTS  # noqa: E402

PAGE = (ROOT / "docs/appendix/referee.md").read_text(encoding="utf-8")
FIRST_RIGHT, ERROR, SECONDS = (
    next(each for each in score.SCORES if each.key == key) for key in ("first_right", "error", "cpu_seconds")
)


def effect(name, *joints, implied=()):
    return {"effect": name, "joints": list(joints), "implied": list(implied), "undecided": "", "confused_with": []}


def label(*effects, withheld=(), nearest=(), outside=False, truth=()):
    return {
        "effects": list(effects),
        "withheld": list(withheld),
        "nearest": list(nearest),
        "outside": outside,
        "truth": list(truth),
    }


def known(effect, quantity, joint, value, nominal, drawn=True):
    return {
        "effect": effect,
        "quantity": quantity,
        "joint": joint,
        "value": value,
        "nominal": nominal,
        "drawn": drawn,
    }


def named(*causes):
    return Answer("armlink", [Cause(name, ("joint_1",), confidence) for name, confidence in causes])


def test_the_first_cause_is_judged_by_its_family():
    coulomb = label(effect("friction.coulomb", "joint_1"))
    assert score.judge(named(("friction.stribeck", 0.9)), coulomb)["first_right"] == 1.0
    wrong = score.judge(named(("link.payload", 0.9), ("friction.coulomb", 0.9)), coulomb)
    assert (wrong["first_right"], wrong["false_sure"], wrong["abstains"]) == (0.0, 1.0, None)
    unsure = score.judge(named(("link.payload", 0.8)), coulomb)
    assert (unsure["first_right"], unsure["false_sure"]) == (0.0, 0.0)
    assert score.judge(named(), coulomb)["first_right"] == 0.0


def test_what_a_true_effect_brings_with_it_is_skipped():
    asymmetric = label(effect("friction.asymmetric", "joint_1", implied=["transmission.spring"]))
    made = score.judge(named(("transmission.spring", 0.9), ("friction.asymmetric", 0.6)), asymmetric)
    assert (made["first_right"], made["false_sure"]) == (1.0, 0.0)


def test_a_tool_abstains_where_nothing_can_be_named():
    nothing, withheld = label(), label(effect("actuator.gain", "joint_1"), withheld=["actuator.gain"])
    for case in (nothing, withheld):
        assert score.judge(named(("friction.viscous", 0.5)), case)["abstains"] == 1.0
        assert score.judge(named(("friction.viscous", 0.9)), case)["abstains"] == 0.0
        assert score.judge(named(("friction.viscous", 0.9)), case)["first_right"] is None
    drag = label(outside=True, nearest=["friction.viscous"])
    assert score.judge(named(("friction.viscous", 0.9)), drag)["abstains"] == 1.0


def test_what_is_not_offered_has_no_score():
    made = score.judge(Answer("mujoco"), label(effect("friction.coulomb", "joint_1")))
    assert set(made.values()) == {None}


def test_parameters_are_compared_with_the_true_change():
    truth = [
        known("friction.coulomb", "torque", "joint_1", 0.5, 0.1),
        known("friction.viscous", "damping", "joint_1", 2.0, 2.0, drawn=False),
    ]
    answer = Answer(
        "mujoco",
        parameters=[
            Parameter("frictionloss", "joint_1", 0.42, 0.3, 0.54, 0.1),
            Parameter("damping", "joint_1", 2.2, 2.1, 2.3, 2.0),
            Parameter("armature", "joint_1", 1.0, 0.9, 1.1, 1.0),
        ],
    )
    made = score.judge(answer, label(effect("friction.coulomb", "joint_1"), truth=truth))
    assert made["error"] == pytest.approx(0.08 / 0.4)
    assert made["width"] == pytest.approx(0.24 / 0.4)
    assert made["coverage"] == 0.5
    assert score.offers(answer) == ["no causes", "parameters", "intervals"]
    assert made["read_right"] == 1.0, "0.32 / 0.12 half widths of friction, 0.2 / 0.1 of damping"
    viscous = score.judge(answer, label(effect("friction.viscous", "joint_1"), truth=truth))
    assert viscous["read_right"] == 0.0


def test_intervals_over_cases():
    made = score.estimate([1.0, 1.0, 0.0, 1.0], FIRST_RIGHT)
    assert made["value"] == 0.75
    assert (made["low"], made["high"]) == pytest.approx((0.3006, 0.9544), abs=1e-4), "Wilson"
    ratio = score.estimate([0.1, 10.0], ERROR)
    assert (ratio["value"], ratio["low"], ratio["high"]) == pytest.approx((1.0, 0.1, 10.0))


def test_a_difference_is_decided_over_enough_cases():
    decided = lambda pairs, key: score.is_decided(score.advantage(pairs, key), 0.05)  # noqa: E731
    assert decided([(1.0, 2.0)] * 6, ERROR)
    assert not decided([(1.0, 2.0)] * 5, ERROR)
    assert not decided([(2.0, 1.0)] * 6, ERROR)
    assert not decided([(1.0, 2.0), (2.0, 1.0)] * 6, SECONDS)
    assert decided([(1.0, 0.0)] * 6, FIRST_RIGHT)
    assert not decided([(1.0, 1.0)] * 20, FIRST_RIGHT)
    random = np.random.default_rng(3)
    alike = [score.is_decided(random.normal(size=20), 0.05) for _ in range(4000)]
    assert np.mean(alike) == pytest.approx(0.025, abs=0.008), "of each direction"


def test_tools_that_are_alike_are_seldom_told_apart():
    """Seven tools whose errors are drawn alike: no score decides anything in 19 of 20 rounds."""
    random, decided = np.random.default_rng(5), 0
    for _ in range(200):
        errors = random.lognormal(size=(7, 30))
        rows = [
            row(f"t{k}", str(case), error=value) for k, each in enumerate(errors) for case, value in enumerate(each)
        ]
        decided += any(each["decided"] for each in score.summary(rows)["differences"])
    assert decided <= 20, "binomial: 10 of 200, at most 20 with a probability of 0.999"


def row(tool, case, state="answered", nameable=True, **scores):
    every = dict.fromkeys(each.key for each in score.SCORES)
    return {
        "tool": tool,
        "case": case,
        "state": state,
        "why": "",
        "nameable": nameable,
        "offers": ["causes"] if tool == "armlink" else ["no causes", "model"],
        "scores": {**every, **scores},
    }


def test_a_tool_that_fails_leaves_the_nominal_model_and_names_nothing():
    rows = [
        row("a", "1", first_right=1.0, false_sure=0.0, residual=0.5),
        row("a", "2", "failed"),
        row("a", "3", "not offered"),
    ]
    score.complete(rows)
    assert rows[1]["scores"]["first_right"] == 0.0
    assert rows[1]["scores"]["residual"] == 1.0
    assert rows[1]["scores"]["rollout"] is None, "which it never offered"
    assert set(rows[2]["scores"].values()) == {None}


def test_the_table_says_who_is_better_and_what_is_not_offered():
    rows = [row("peer", str(k), residual=0.5, rollout=0.4) for k in range(8)]
    rows += [row("armlink", str(k), residual=0.6, rollout=0.41, first_right=1.0) for k in range(8)]
    found = score.summary(rows)
    pair = {"better": "peer", "worse": "armlink", "cases": 8, "decided": True}
    assert {"score": "residual", **pair} in found["differences"]
    assert found["scores"]["first_right"]["peer"] is None
    assert score.no_worse(rows, "armlink", "residual", 0.05) == (0, 8)
    assert score.no_worse(rows, "armlink", "rollout", 0.05) == (8, 8)
    made = {"seeds": [1], "date": "2026-11-29", "cases": 8, "cpu_seconds": 60.0, "sealed": ["0" * 64], "summary": found}
    made |= {"rows": rows, "no_worse": {"residual": (0, 8)}}
    text = page.markdown([made])
    assert "| right cause first | not offered | 100 % (68 to 100; 8) |" in text
    assert "| error of a parameter / its true change | not offered | not offered |" in text
    assert "held-out residual / that of the nominal model: peer is better than armlink" in text
    assert "not offered" in page.svg(made)
    turned = [
        {**each, "better": each["worse"], "worse": each["better"], "decided": False} for each in found["differences"]
    ]
    other = {**made, "seeds": [2], "summary": {**found, "differences": turned}}
    assert "in the other order: none." in page.markdown([made, made])
    assert "in the other order: held-out residual / that of the nominal model: peer" in page.markdown([made, other])


def test_nobody_reads_or_changes_what_is_sealed(tmp_path):
    digest = seal.seal(tmp_path, "case_000", {"label": {"effects": ["friction.coulomb"]}}, b"k" * 32)
    assert b"friction" not in (tmp_path / "case_000.sealed").read_bytes()
    assert seal.opened(tmp_path, "case_000", b"k" * 32, digest) == {"label": {"effects": ["friction.coulomb"]}}
    changed = bytearray((tmp_path / "case_000.sealed").read_bytes())
    changed[-5] ^= 1
    (tmp_path / "case_000.sealed").write_bytes(bytes(changed))
    with pytest.raises(ValueError, match="not what was sealed"):
        seal.opened(tmp_path, "case_000", b"k" * 32, digest)


def test_every_effect_has_a_family():
    assert {*CATALOGUE, *EFFECTS} <= score.FAMILY.keys()


def test_adapters_are_short_and_on_the_page():
    adapters = {path.stem: path for path in (ROOT / "benchmarks/referee/adapters").glob("*.py")}
    for name, path in adapters.items():
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 60, name
        assert f"| `{name}` |" in PAGE


def test_a_round_with_the_adapter_of_the_page(tmp_path, monkeypatch):
    """Half of the time is MuJoCo's: one arm, three recordings of six seconds."""
    monkeypatch.setattr(mujoco_plant, "SECONDS", 6.0)
    code = next(text for text in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "Ridge" in text)
    (tmp_path / "ridge.py").write_text(code, encoding="utf-8")
    (tmp_path / "sealed").mkdir()
    case, digest = draw.draw_case(3, 0, "MuJoCo, motor torque, one effect", tmp_path, b"k" * 32, 60.0, None)
    public = tmp_path / "cases" / case
    assert sorted(path.name for path in public.iterdir()) == ["case.json", "sim.xml", "train_1.csv", "train_2.csv"]
    opened = seal.opened(tmp_path / "sealed", case, b"k" * 32, digest)
    nominal = (public / "sim.xml").read_text(encoding="utf-8")
    rows = []
    for tool in contest.tools([tmp_path / "ridge.py"], ["nominal", "ridge"]):
        made = {"tool": tool.name, "case": case, **contest.run(tool, public, 60.0)}
        assert made["state"] == "answered", made
        rows.append((made, rounds.score_row(made, opened, nominal)["scores"]))
    (_, bare), (ridge, scores) = rows
    assert (bare["residual"], bare["rollout"], bare["error"]) == (1.0, 1.0, None)
    assert scores["first_right"] is None
    truth = {(each["effect"], each["joint"]): each for each in opened["label"]["truth"] if each["drawn"]}
    (true,) = truth.values()
    words = {v.partition(":")[0]: k for k, v in score.TABLES["vocabularies"]["mujoco"].items()}
    told = [p for p in answer_from_json(ridge["answer"]).parameters if p.joint == true["joint"]]
    (mine,) = [p for p in told if p.name == words[true["effect"]]]
    by_hand = abs(mine.value - true["value"]) / abs(true["value"] - true["nominal"])
    assert scores["error"] == pytest.approx(by_hand)
    assert scores["residual"] < 1.0
    of_case = interface.load_case(public)
    quantity = score.TABLES["vocabularies"]["mujoco"]
    (name,) = (word for word, target in quantity.items() if target == f"{true['effect']}:{true['quantity']}")
    truth = Answer("mujoco", None, None, mjcf.corrected(of_case, {(name, true["joint"]): true["value"]}))
    of_truth = rounds.score_row({**made, "answer": truth.to_json()}, opened, nominal)["scores"]
    assert of_truth["residual"] < 1.01 * scores["residual"], "no model is better than the true one"


def test_a_tool_that_is_not_there_or_never_ends_is_said_so(tmp_path, monkeypatch):
    (tmp_path / "absent.py").write_text("import a_package_that_nobody_has\n", encoding="utf-8")
    (tmp_path / "sick.py").write_text("def solve(case):\n    raise KeyError('no')\n", encoding="utf-8")
    (tmp_path / "endless.py").write_text("def solve(case):\n    while True:\n        pass\n", encoding="utf-8")
    monkeypatch.setattr(contest, "GRACE_S", 0.0)
    (tmp_path / "case").mkdir()
    told = {"joints": ["joint_1"], "kind": "torque", "withheld": [], "cpu_seconds": 5.0}
    (tmp_path / "case/case.json").write_text(json.dumps(told), encoding="utf-8")
    files = [tmp_path / f"{name}.py" for name in ("absent", "endless", "sick")]
    tools = contest.tools(files, [path.stem for path in files])
    states = {tool.name: contest.run(tool, tmp_path / "case", 2.0) for tool in tools}
    assert states["endless"]["state"] == "out of time"
    assert states["absent"]["state"] == "not installed"
    assert (states["sick"]["state"], states["sick"]["why"]) == ("failed", "KeyError: 'no', line 2")


FRICTION = ("frictionloss", "joint_1")


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (Answer("words", []), "vocabulary 'words' is not in families.json"),
        (Answer("mujoco", [Cause("frictionlos", ("joint_1",), 0.9)]), "cause 'frictionlos': the vocabulary 'mujoco'"),
        (Answer("mujoco", [Cause("damping", ("joint_1",), 3.0)]), "confidence 3.0 instead of 0 to 1"),
        (Answer("mujoco", [Cause("damping", ("joint_1",), math.nan)]), "confidence nan"),
        (Answer("mujoco", [Cause("damping", ("elbow",), 0.9)]), "the model has no joint 'elbow'"),
        (Answer("mujoco", None, [Parameter("damping", "elbow", 0.1)]), "of joint 'elbow': the model has no such joint"),
        (Answer("mujoco", None, [Parameter(*FRICTION, math.nan)]), "is not a finite number"),
        (Answer("mujoco", None, [Parameter(*FRICTION, 0.1, 0.2, 0.0)]), "0.1 is not between 0.2 and 0.0"),
        (Answer("mujoco", None, None, "no model"), "model: XML parse error"),
        (Answer("mujoco", None, None, "<mujoco/>"), "model: it lacks the joint joint_1"),
    ],
)
def test_an_answer_that_cannot_be_judged_is_a_failure_with_its_reason(tmp_path, answer, said):
    told = {"joints": ["joint_1"], "kind": "torque", "withheld": [], "cpu_seconds": 5.0}
    (tmp_path / "case.json").write_text(json.dumps(told), encoding="utf-8")
    with pytest.raises(ValueError, match=said):
        contest.judgeable(answer, tmp_path)
    good = Parameter(*FRICTION, 0.1, 0.0, math.inf, 0.0)
    contest.judgeable(Answer("mujoco", [Cause("damping", ("joint_1",), 0.9)], [good]), tmp_path)


def test_a_tool_that_always_fails_is_not_one_that_offers_nothing():
    rows = [row("armlink", "1", residual=0.5), {**row("peer", "1", "failed"), "why": "KeyError: 'no'", "offers": []}]
    made = {"seeds": [1], "date": "2026-11-30", "cases": 1, "cpu_seconds": 60.0, "sealed": ["0" * 64], "rows": rows}
    text = page.markdown([{**made, "summary": score.summary(rows), "no_worse": {}}])
    assert re.search(r"\| held-out residual / that of the nominal model \|.*\| no answer \|", text)
    assert "- `peer` failed (1 case): KeyError: 'no'" in text


FILTER = '<position joint="j" kp="30" kv="1" timeconst="0.1"/>'
DELAY = '<position joint="j" kp="30" kv="1" delay="0.04" nsample="30"/>'


@pytest.mark.parametrize("servo", [FILTER, DELAY], ids=["filter", "delay"])
def test_a_servos_own_recording_leaves_noise_in_every_window(servo):
    """A window begins with the servo as its past commands leave it."""
    text = (
        '<mujoco><option timestep="0.002"/><worldbody><body><joint name="j" axis="0 1 0" armature="0.02"/>'
        f'<inertial pos="0 0 -0.2" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody><actuator>{servo}'
        "</actuator></mujoco>"
    )
    model = mujoco.MjModel.from_xml_string(text)
    data, rows = mujoco.MjData(model), []
    for k in range(800):
        data.ctrl[0] = 0.6 * np.sin(0.05 * k) * np.sin(0.011 * k)
        rows.append([0.01 * k, data.qpos[0], data.ctrl[0]])
        mujoco.mj_step(model, data, 5)
    t, q, command = np.transpose(rows)
    made = measure.errors(text, ("j",), "positions", {"t": t, "q": q[:, None], "q_cmd": command[:, None]})
    assert max(made.values()) < 0.003, "a step of 2 ms; 0.06 without the past"
