"""Recordings that cannot be used: one clear line, or an honest answer; never a traceback."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import THREE, Wrong, model, record

from armlink.cli import run
from armlink.errors import BadInput
from armlink.recording.files import save_recording
from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose


def good(seconds: float = 12.0, **options) -> Recording:
    return record(model(), Wrong(coulomb=np.full(3, 0.5)), seconds=seconds, rate=50.0, **options)


def test_too_few_rows():
    with pytest.raises(BadInput, match=r"3 rows.*too short"):
        diagnose(model(), [replace(good(), t=np.arange(3) * 0.1, position=np.zeros((3, 3)),
                                   torque=np.zeros((3, 3)), motor_torque=None)])  # fmt: skip


def test_another_number_of_joints():
    recording = good()
    two = Recording(t=recording.t, position=recording.position[:, :2], torque=recording.torque[:, :2])
    with pytest.raises(BadInput, match=r"3 hinge joints.*recording has 2"):
        diagnose(model(), [two])


def test_at_rest():
    recording = good()
    still = replace(recording, position=np.tile(recording.position[:1], (len(recording.t), 1)))
    with pytest.raises(BadInput, match=r"no joint moves.*cannot be found"):
        diagnose(model(), [still])


def test_a_column_without_numbers():
    recording = good()
    torque = recording.torque.copy()
    torque[:, 1] = np.nan
    with pytest.raises(BadInput, match=r"tau_2 holds only 0 numbers"):
        diagnose(model(), [replace(recording, torque=torque)])


def test_rows_of_nan_are_left_out():
    recording = good(30.0)
    holes = {name: getattr(recording, name).copy() for name in ("position", "torque", "motor_torque")}
    for values in holes.values():
        values[300:330] = np.nan
    answer = diagnose(model(), [replace(recording, **holes)])
    assert answer.causes[0].effect == "friction.coulomb"


def test_a_constant_torque_column_gives_an_answer():
    recording = good(30.0)
    torque = recording.torque.copy()
    torque[:, 2] = 1.0
    assert diagnose(model(), [replace(recording, torque=torque)]).verdict in ("unexplained", "ambiguous", "explained")


@pytest.mark.parametrize(
    ("rows", "line"),
    [
        ("t,q_1,q_2,q_3\n0,0,0,0\n1,0,0,0\n", "no torque channel"),
        ("t,q_1,q_2,q_3,tau_1,tau_2,tau_3\n0,0,0,0,0,0,0\n2,0,0,0,0,0,0\n1,0,0,0,0,0,0\n", "time must increase"),
    ],
)
def test_the_command_says_it_in_one_line(tmp_path, capsys, rows, line):
    (tmp_path / "arm.xml").write_text(THREE)
    (tmp_path / "bad.csv").write_text(rows)
    status = run(["gap", "diagnose", "--sim", str(tmp_path / "arm.xml"), "--train", str(tmp_path / "bad.csv")])
    said = capsys.readouterr().err
    assert status == 2
    assert line in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("<mujoco><worldbody><body></worldbody></mujoco>", "MuJoCo cannot read this model"),
        (
            "<mujoco><worldbody><body><joint type='free'/><geom size='1'/></body></worldbody></mujoco>",
            "the model has no hinge or slide",
        ),
    ],
)
def test_a_model_that_cannot_be_used_is_refused_in_one_line(tmp_path, text, line):
    (tmp_path / "arm.xml").write_text(text)
    with pytest.raises(BadInput, match=line) as refused:
        diagnose(tmp_path / "arm.xml", [good()])
    assert "\n" not in str(refused.value)


def test_json_on_standard_output_is_nothing_but_json(tmp_path, capsys):
    import json

    (tmp_path / "arm.xml").write_text(THREE)
    save_recording(good(30.0), tmp_path / "a.csv")
    paths = {name: str(tmp_path / name) for name in ("arm.xml", "a.csv", "report.html", "out.xml")}
    options = ["--json", "-", "--report", paths["report.html"], "--out-model", paths["out.xml"]]
    assert run(["gap", "diagnose", "--sim", paths["arm.xml"], "--train", paths["a.csv"], *options]) == 0
    assert json.loads(capsys.readouterr().out)["schema"] == "armlink.gap/2"
    page = (tmp_path / "report.html").read_text()
    assert "friction.coulomb" in page
    assert 'src="http' not in page
    assert 'frictionloss="0.5' in (tmp_path / "out.xml").read_text()


def test_a_bench_on_other_channels_is_one_line(capsys):
    assert run(["gap", "bench", "--channels", "q,tau", "--cases", "1"]) == 2
    assert "--channels q,tau: expected q,q_cmd" in capsys.readouterr().err
