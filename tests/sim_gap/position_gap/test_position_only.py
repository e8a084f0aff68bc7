import json
import sys
import types
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record, written

from armlink.errors import BadInput
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.position_answer import _beyond, _faster, _lowers, _released, _verdict
from sim_gap.position_gap.identify import gain_scales
from sim_gap.position_gap.training.bands import band
from sim_gap.position_gap.training.export import export_with_module
from sim_gap.position_gap.training.position_files import (
    batch_path,
    export_batched,
    write_actuators,
    write_exported,
    write_samples,
)
from sim_gap.position_gap.training.replay import Simulated, replay_rms
from sim_gap.position_gap.training.spread import gaps_left_out, known_before, terms_of
from sim_gap.report.figures import motion_figure
from sim_gap.report.page import write_report

REAL = model_text(kp=15.0, friction=0.25)


@pytest.fixture(scope="module")
def answer(tmp_path_factory):
    sim = written(tmp_path_factory.mktemp("arm"), model_text(kp=120.0, friction=0.0))
    return diagnose(sim, [record(REAL, 1, 20.0)], [record(REAL, 2, 14.0)])


@pytest.mark.slow
def test_names_the_controller_and_the_friction(answer) -> None:
    named = {cause.effect: cause for cause in answer.causes}
    assert answer.unit == "rad"
    assert answer.verdict in ("explained", "ambiguous")
    assert answer.causes[0].effect in ("controller.stiffness", "friction.coulomb")
    for effect, name, value in (("controller.stiffness", "kp", 15.0), ("friction.coulomb", "torque", 0.25)):
        for joint in ("shoulder", "elbow"):
            found = named[effect].parameters[joint][name]
            assert abs(found.value - value) < 0.15 * value
            assert found.low < found.value < found.high
    assert {cause.effect for cause in answer.causes} == {"controller.stiffness", "friction.coulomb"}
    assert (answer.heldout_after < 0.25 * answer.heldout_before).all()


def test_a_gap_that_matters_nowhere_is_none() -> None:
    """Causes that make a gap within the margin smaller are as minor as it; so are those of a sound arm's gap."""

    def verdict(
        *gaps: float,
        sound: bool | None = None,
        moved: tuple[Sequence[float], Sequence[float]] | None = None,
        left: float | None = None,
    ) -> str:
        gap, search = np.array(gaps), SimpleNamespace(open_controller=sound is None)
        found = SimpleNamespace(margin=np.full(2, 1e-4), sound=bool(sound), search=search, train_before=gap)
        found.moved_train, found.moved_before = np.array(moved if moved is not None else np.full((2, 2), np.nan))
        found.heldout_before, found.heldout_after, found.train_after = gap, 0.1 * gap, (left or 0.1) * gap
        causes = [SimpleNamespace(confounded_with=(), confidence=0.75)] if left is None else []
        return _verdict(found, causes, 0.01 if left is None else 1.0)

    assert verdict(0.00009, 0.00008) == "no_gap"
    assert verdict(0.0010, 0.0018) == "explained"
    assert verdict(0.0010, 0.0018, sound=False) == "explained"
    assert verdict(0.0010, 0.0018, sound=True) == "no_gap"
    assert verdict(0.0010, 0.0018, moved=([5e-5, 9e-5], [8e-5, 7e-5])) == "no_gap"
    assert verdict(0.0010, 0.0018, moved=([5e-5, 9e-5], [8e-5, 2e-4])) == "explained"
    assert verdict(0.0010, 0.0018, moved=([5e-5, 2e-4], [8e-5, 7e-5])) == "explained"
    assert verdict(0.0010, 0.0018, moved=([5e-5, 9e-5], [np.nan, np.nan])) == "explained"
    assert verdict(0.00015, 0.00018, left=1.0) == "no_gap"
    assert verdict(0.00015, 0.00018, moved=([0.02, 9e-5], [8e-5, 7e-5]), left=1.0) == "unexplained"
    assert verdict(0.0010, 0.0018, left=1.0) == "unexplained"


def test_what_lowers_a_gap_that_is_none_is_no_cause() -> None:
    """A controller that had to be found leaves the shoulder a gap, and the elbow none that Coulomb friction lowers."""
    found = SimpleNamespace(heldout_before=np.array([0.002, 0.001]), margin=np.array([0.001, 0.004]))
    halved = SimpleNamespace(before=np.array([0.002, 0.001]), share=np.array([0.0, 0.5]))
    assert not _lowers(found, halved)
    assert _lowers(found, SimpleNamespace(before=halved.before, share=halved.share[::-1]))
    assert _lowers(found, SimpleNamespace(before=np.array([0.002, 0.005]), share=halved.share))


def test_joints_that_go_further_than_in_training_are_noted() -> None:
    near, far = np.linspace(-0.1, 0.1, 50), np.linspace(-0.3, 0.3, 50)
    fitted, other = (
        SimpleNamespace(measured=np.stack(columns, axis=1)[..., None], weight=np.ones((50, 2, 1)))
        for columns in ((near, far), (far, near))
    )
    arm = SimpleNamespace(names=("shoulder", "elbow"))
    found = SimpleNamespace(sim=SimpleNamespace(arm=arm), search=SimpleNamespace(data=fitted), heldout=other)
    (note,) = _beyond(found)
    assert "shoulder: 68% of the held-out motion" in note
    assert "elbow" not in note


def test_joints_that_go_faster_than_in_training_are_noted() -> None:
    slow, fast = np.linspace(-0.2, 0.2, 50), np.linspace(-1.5, 1.5, 50)
    fitted, other = (
        SimpleNamespace(v=np.stack(columns, axis=1)[..., None], weight=np.ones((50, 2, 1)))
        for columns in ((slow, fast), (fast, slow))
    )
    arm = SimpleNamespace(names=("shoulder", "elbow"))
    found = SimpleNamespace(sim=SimpleNamespace(arm=arm), search=SimpleNamespace(data=fitted), heldout=other)
    (note,) = _faster(found)
    assert "shoulder up to 1.5 rad/s (in training 0.2)" in note
    assert "elbow" not in note
    assert _faster(SimpleNamespace(sim=found.sim, search=found.search, heldout=fitted)) == []


def test_joints_that_swing_with_the_servo_off_in_the_held_out_motion_alone_are_noted() -> None:
    fitted, other = (SimpleNamespace(served=np.ones((50, 2, 4))) for _ in range(2))
    other.served[:, 0, 3] = 0.0
    arm = SimpleNamespace(names=("shoulder", "elbow"))
    found = SimpleNamespace(sim=SimpleNamespace(arm=arm), search=SimpleNamespace(data=fitted), heldout=other)
    (note,) = _released(found)
    assert (
        "never in training, so the fit may not hold there: shoulder for 25 % of the time: add such a "
        "recording, with the servo off, to --train" in note
    )
    assert _released(SimpleNamespace(sim=found.sim, search=found.search, heldout=fitted)) == []
    assert _released(SimpleNamespace(sim=found.sim, search=SimpleNamespace(data=other), heldout=other)) == []


def test_the_written_model_moves_like_the_arm(answer, tmp_path: Path) -> None:
    batch_path(tmp_path / "closed.xml").write_text("<mujoco/>")  # of an earlier model
    write_exported(answer.internals, tmp_path / "closed.xml")
    closed = mujoco.MjModel.from_xml_path(str(tmp_path / "closed.xml"))
    other = [record(REAL, 3, 14.0)]
    before = replay_rms(Simulated(mujoco.MjModel.from_xml_string(model_text(kp=120.0, friction=0.0)), (0, 1)), other)
    assert (replay_rms(Simulated(closed, (0, 1)), other) < 0.3 * before).all()
    assert answer.to_json()["rollout"]["closed_loop"] is True
    assert export_batched(answer.internals) is None
    assert not batch_path(tmp_path / "closed.xml").exists()


def test_a_model_with_a_slew_limit_is_written_without_pid_too(answer, tmp_path: Path) -> None:
    """MuJoCo Warp runs no PID actuator."""
    found = answer.internals
    limited = found.native.with_values(slew=np.array([1.5, np.inf]))
    limited = limited.freed([(0, "kp"), (0, "slew"), (0, "coulomb"), (0, "viscous"), *((1, n) for n in limited.at(1))])
    changed = replace(found)
    vars(changed)["native"] = limited
    other = export_batched(changed)
    assert other is not None
    model = mujoco.MjModel.from_xml_string(other.xml)
    assert not (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_PID).any()
    assert abs(model.actuator_gainprm[0, 0] - found.native.point["kp"][0]) < 0.1 * found.native.point["kp"][0]


def test_a_module_is_written_with_its_model_and_removed_with_it(answer, tmp_path: Path) -> None:
    found = answer.internals
    rubs = found.fit.with_values(load=np.array([0.3, 0.0]))
    rubs = rubs.freed([*rubs.free, (0, "load")])
    beside = export_with_module(found.sim, found.search, rubs)
    changed = replace(found)
    vars(changed)["beside"] = beside
    write_exported(changed, tmp_path / "closed.xml")
    text = (tmp_path / "closed_effects.xml").read_text()
    assert text.startswith("<!-- Use this model with closed_effects.py, which applies:\n  friction.load shoulder\n-->")
    mujoco.MjModel.from_xml_string(text)
    made: dict = {}
    exec((tmp_path / "closed_effects.py").read_text(), made)
    assert (made["MODEL"], made["EFFECTS"]) == ("closed_effects.xml", beside.effects)
    write_exported(found, tmp_path / "closed.xml")
    assert [path.name for path in tmp_path.iterdir()] == ["closed.xml"]


def test_samples_scatter_about_the_fit(answer, tmp_path: Path) -> None:
    write_samples(answer.internals, 200, tmp_path / "draws.json")
    rows = json.loads((tmp_path / "draws.json").read_text())["samples"]
    gains = np.array([row["shoulder.kp"] for row in rows])
    assert len(rows) == 200
    assert gains.std() > 0.0
    assert abs(np.median(gains) - answer.internals.fit.point["kp"][0]) < gains.std()
    (note,) = [note for note in answer.notes if note.startswith("the training motion does not reach these limits")]
    least = float(note.split("torque at least shoulder ")[1].split(",")[0])
    assert 0.8 * least < min(row["shoulder.limit"] for row in rows) < 1.3 * least
    write_samples(answer.internals, 3, tmp_path / "draws.csv")
    assert len((tmp_path / "draws.csv").read_text().splitlines()) == 4
    with pytest.raises(BadInput, match=r"\.csv, \.json, \.parquet"):
        write_samples(answer.internals, 3, tmp_path / "draws.txt")


@pytest.mark.long
def test_actuator_entries_hold_the_fit(answer, tmp_path: Path, monkeypatch) -> None:
    for name, entry in (
        ("isaaclab.actuators", "DelayedPDActuatorCfg"),
        ("mjlab.actuator", "BuiltinPositionActuatorCfg"),
    ):
        module = types.ModuleType(name)
        setattr(module, entry, dict)
        monkeypatch.setitem(sys.modules, name.partition(".")[0], types.ModuleType(name.partition(".")[0]))
        monkeypatch.setitem(sys.modules, name, module)
    write_actuators(answer.internals, tmp_path / "servos.py", 0.002)
    made: dict = {}
    exec((tmp_path / "servos.py").read_text(), made)
    isaac, mjlab = made["isaac_lab"](), made["mjlab"]()
    native = answer.internals.native.point
    for j, joint in enumerate(("shoulder", "elbow")):
        (other,) = [entry for entry in mjlab if entry["target_names_expr"] == (joint,)]
        entry = isaac[joint]
        assert entry["stiffness"] == other["stiffness"] == pytest.approx(native["kp"][j], rel=1e-5)
        assert entry["friction"] == other["frictionloss"] == pytest.approx(native["coulomb"][j], rel=1e-5)
        assert entry["viscous_friction"] == other["viscous_damping"] == pytest.approx(native["viscous"][j], rel=1e-5)
        assert entry["armature"] == other["armature"] == pytest.approx(0.02, rel=0.3)
        assert 0 <= entry["min_delay"] <= entry["max_delay"] < 5
    with pytest.raises(BadInput, match=r"ends in \.py"):
        write_actuators(answer.internals, tmp_path / "servos.yaml")
    with pytest.raises(BadInput, match="--physics-step 0"):
        write_actuators(answer.internals, tmp_path / "servos.py", 0.0)


def test_the_band_holds_its_share_of_other_motion(answer) -> None:
    told = answer.to_json()["band"]
    assert told["share"] == 0.9
    assert min(told["holds"]) > 0.8
    assert np.mean(told["holds"]) <= 0.98
    found = answer.internals
    terms = terms_of(found.search, found.fit)
    left = gaps_left_out(found.search.data, terms, known_before(found.search, found.fit))
    known = band(found.search, found.fit, replace(found.spread, limits=()), left, found.heldout)
    assert ((known.width > 0.0) & (known.width < 0.03 * answer.heldout_before)).all()
    assert all(1.0 < width / own < 25.0 for width, own in zip(told["half_width"], known.width, strict=True))


def test_each_cause_is_replayed_alone_and_left_out(answer) -> None:
    effects = {each["effect"]: each for each in answer.to_json()["rollout"]["effects"]}
    assert effects.keys() == {"controller.stiffness", "friction.coulomb"}
    after, before = answer.rollout.after, answer.rollout.before
    for each in effects.values():
        assert (np.array(each["without"]) > 1.5 * after).all()
    assert (np.array(effects["controller.stiffness"]["alone"]) < before).all()
    worst = [max(each["without"]) for each in answer.to_json()["rollout"]["effects"]]
    assert worst == sorted(worst, reverse=True)


def test_the_picture_of_the_motion_can_leave_each_cause_out(answer) -> None:
    figure = motion_figure(answer.internals, answer.causes)
    lines = {trace.name: trace for trace in figure.data if trace.yaxis == "y"}
    shown = [name for name, trace in lines.items() if trace.visible is True]
    assert shown == ["command", "measured", "nominal model", "corrected model"]
    hidden = {name for name, trace in lines.items() if trace.visible == "legendonly"}
    assert hidden == {"without controller.stiffness", "without friction.coulomb"}
    measured = np.array(lines["measured"].y)
    left = {name: np.std(np.array(trace.y) - measured) for name, trace in lines.items()}
    assert all(left[name] > 1.5 * left["corrected model"] for name in hidden)


def test_report_shows_every_joint(answer, tmp_path: Path) -> None:
    write_report(answer, tmp_path / "gap.html")
    page = (tmp_path / "gap.html").read_text()
    assert "Motion of every joint" in page
    assert "controller.stiffness" in page


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda q, c: -c, "--sign q_cmd_1=-1"),
        (lambda q, c: c[:, ::-1], "--map"),
        (lambda q, c: np.rad2deg(c), "--units q_cmd_1=deg"),
        (lambda q, c: np.rad2deg(c, out=c) * (1.0 + 0.0 * np.rad2deg(q, out=q)), "--units q=deg,q_cmd=deg"),
        (lambda q, c: np.full_like(c, np.nan), "no torque channel and no commanded position"),
    ],
)
def test_commands_that_do_not_belong_are_refused(change, message: str) -> None:
    recording = record(REAL, 4, 14.0)
    recording.position_command[:] = change(recording.position, recording.position_command.copy())
    with pytest.raises(BadInput, match=message):
        diagnose(mujoco.MjModel.from_xml_string(REAL), [recording], [recording])


def test_gains_of_recordings() -> None:
    labels = ["a/run_kp100.csv", "a/run_kp400.csv"]
    assert gain_scales(["*kp100*=100", "*kp400*=400"], labels) == [1.0, 4.0]
    with pytest.raises(BadInput, match="no gain is given for a/run_kp400"):
        gain_scales(["*kp100*=100"], labels)
    with pytest.raises(BadInput, match="no recording of this name"):
        gain_scales(["*kp9*=100"], labels)
    with pytest.raises(BadInput, match="expected RECORDING=VALUE"):
        gain_scales(["*kp100*=fast"], labels)
