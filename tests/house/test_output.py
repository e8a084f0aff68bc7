"""Results on standard output, hints on standard error, whole names at any width, prompts that stay readable."""

import json
import os
import pty
import re
import shutil
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest
from wrong_arms import THREE, Wrong, model, record

from armlink import cli
from armlink.arm_file import bundled_arms
from armlink.recording.files import save_recording

ROOT = Path(__file__).parents[2]
LONG = "j2s6s200_joint_"
"""Begins the names of the joints here: only their last character differs."""
ON_BUS = ["--bus", "armlink_sim:arm.yaml"]
COMMANDS = {
    "new": ["new", "arm.urdf", "--out", "made.yaml", "--force", "--stops", f"{LONG}4:-2.5:2.5"],
    "doctor": ["doctor", "arm.yaml"],
    "scan": ["scan", "arm.yaml", *ON_BUS],
    "monitor": ["monitor", "arm.yaml", *ON_BUS, "--sync", "--cycles", "1"],
    "check": ["check", "arm.yaml", *ON_BUS],
    "sweep --plan": ["sweep", "arm.yaml", "--plan"],
    "torque": ["torque", "arm.yaml", "--q", "poses.csv"],
    "convert": ["convert", "run.csv", "run.mcap"],
    "replay": ["replay", "arm.yaml", "run.csv"],
    "drives": ["drives"],
    "history": ["history", "arm.yaml", "--store", "records.db"],
    "gap plan": ["gap", "plan", "arm.yaml", "--out", "motion.csv", "--joint", f"{LONG}2"],
    "gap diagnose": ["gap", "diagnose", "--sim", "wrong.xml", "--train", "wrong.csv"],
}
WITHOUT_NAMES = {"doctor", "convert", "replay", "drives", "history", "check"}
NEXT = {"new", "doctor", "scan", "check", "sweep --plan", "history", "gap plan", "gap diagnose"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Models, an arm file and recordings whose joints have long names that end differently."""
    made = tmp_path_factory.mktemp("output")
    urdf = (ROOT / "tests" / "models" / "arm4.urdf").read_text()
    (made / "arm.urdf").write_text(re.sub(r'"j([1-4])"', rf'"{LONG}\1"', urdf))
    (made / "poses.csv").write_text("q_1,q_2,q_3,q_4\n0,0.5,0.5,0\n")
    rows = (f"{k / 100},{k / 100},0,0,0,1,2,3,4\n" for k in range(50))
    (made / "run.csv").write_text("t,q_1,q_2,q_3,q_4,tau_1,tau_2,tau_3,tau_4\n" + "".join(rows))
    (made / "wrong.xml").write_text(THREE.replace("joint_", LONG))
    wrong = record(model(), Wrong(coulomb=[0.6, 0.4, 0.02]), seconds=20, noise=0.02, channels=("tau_motor",))
    save_recording(wrong, made / "wrong.csv")
    here = Path.cwd()
    os.chdir(made)
    try:
        command = ["new", "arm.urdf", "--out", "arm.yaml", "--stops", f"{LONG}4:-2.5:2.5"]
        assert cli.run(command) == 0
    finally:
        os.chdir(here)
    return made


@pytest.fixture
def run(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_STATE_HOME", str(folder / "state"))

    def run(name, *options):
        capsys.readouterr()
        assert cli.run([*COMMANDS[name], *options]) == 0
        return capsys.readouterr()

    return run


@pytest.mark.parametrize("name", COMMANDS)
def test_results_are_on_standard_output_and_hints_on_standard_error(run, name):
    said = run(name)
    assert said.out.strip()
    assert not re.search("[─━│]", said.err), "a table among the hints"
    assert "next: " not in said.out
    if name in NEXT:
        assert said.err.splitlines()[-1].startswith("next: ")
    if name not in WITHOUT_NAMES:
        assert f"{LONG}2" in said.out
    assert said.out.rstrip().splitlines()[-1][0].isalnum(), "ends with a verdict, not with a table"


@pytest.mark.sample(6)
@pytest.mark.parametrize("name", COMMANDS)
def test_json_on_standard_output_is_alone_there(run, name):
    said = run(name, "--json", "-")
    assert json.loads(said.out) is not None
    assert name == "torque" or said.err.strip()


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", ["scan", "gap diagnose", "monitor", "sweep --plan", "torque"])
def test_names_come_whole_on_a_narrow_terminal(run, monkeypatch, name):
    monkeypatch.setenv("COLUMNS", "30")
    said = run(name)
    for number in (1, 2, 3):
        assert f"{LONG}{number}" in said.out
    assert not re.search(r"\w…", said.out), "cut"


def test_a_pipe_is_as_wide_as_its_rows(run, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    rows = [line for line in run("monitor").out.splitlines() if LONG in line]
    assert len(rows) == 4
    assert all("operational" in row for row in rows)


ASKS = """
import time
from armlink.commands.plain_console import PlainConsole, ask, results
with PlainConsole().status("working") as status:
    time.sleep(0.3)
    results().print("found: one")
    time.sleep(0.3)
    answer = ask("Which arm?")
    time.sleep(0.3)
results().print(f"verdict: {answer}")
"""


def on_terminal(command, question, answer, stdout=None, columns=60):
    """What a command writes to a terminal: before its question is shown, while it waits, and after the answer."""
    master, slave = pty.openpty()
    termios.tcsetwinsize(slave, (40, columns))
    environment = {key: value for key, value in os.environ.items() if key != "COLUMNS"} | {"TERM": "xterm"}
    process = subprocess.Popen(command, stdin=slave, stdout=stdout or slave, stderr=slave, env=environment)
    os.close(slave)
    text = read_until(master, question)
    time.sleep(0.6)
    os.write(master, f"{answer}\n".encode())
    waiting, _, begun = read_until(master, answer).partition(answer)
    rest = begun + read_until(master, None)
    os.close(master)
    assert process.wait(timeout=60) == 0, text + waiting + rest
    return text, waiting, rest


def read_until(master, words):
    """Text from a terminal until it has these words; to its end if there are none."""
    text = b""
    while words is None or words not in text.decode(errors="replace"):
        try:
            piece = os.read(master, 4096)
        except OSError:  # the other side has closed
            break
        if not piece:
            break
        text += piece
    return text.decode(errors="replace")


def test_a_prompt_is_not_overwritten_by_a_spinner():
    before, waiting, after = on_terminal([sys.executable, "-c", ASKS], "Which arm?", "both")
    assert "working" in before
    assert before.count("found: one") == 1
    assert "\x1b" not in waiting, "nothing is drawn while the question waits"
    assert "verdict: both" in after


def test_a_question_stays_where_the_spinner_had_two_lines():
    long = ASKS.replace('"working"', '"working " * 10')
    _, _, after = on_terminal([sys.executable, "-c", long], "Which arm?", "both")
    assert "\x1b[1A" not in after.partition("working")[0], "a line above the spinner is erased"


def test_a_table_that_was_watched_leaves_nothing_behind():
    command = [sys.executable, "-m", "armlink.cli", "monitor", "sarcos", "--sync", "--cycles", "1"]
    said = "".join(on_terminal(command, "joints are heard", "nothing is asked"))
    assert said.count("sarcos on simulated arm") == 2, "once while watching, once at the end"


def test_a_question_leaves_standard_output_alone(tmp_path):
    with (tmp_path / "out").open("w") as out:
        on_terminal([sys.executable, "-c", ASKS], "Which arm?", "both", stdout=out)
    assert (tmp_path / "out").read_text() == "found: one\nverdict: both\n"


@pytest.mark.long
def test_new_asks_on_a_terminal_for_what_the_model_does_not_state(folder, tmp_path):
    shutil.copy(folder / "arm.urdf", tmp_path)
    command = [
        sys.executable,
        "-m",
        "armlink.cli",
        "new",
        str(tmp_path / "arm.urdf"),
        "--out",
        str(tmp_path / "a.yaml"),
    ]
    _, waiting, after = on_terminal(command, "or Enter", "-2.5 2.5", columns=100)
    assert "\x1b" not in waiting
    assert "-2.50 +2.50" in after
    assert f"{LONG}4" in after
    command[-1] = str(tmp_path / "b.yaml")
    asked, again, rest = on_terminal(command, "or Enter", "2 -2\nabc\n-2.4 2.4", columns=100)
    said = asked + again + rest
    assert said.count("or Enter") == 3, "a slip of the fingers is asked again"
    assert "expected two numbers, the lower first" in said
    assert "-2.40 +2.40" in said


def test_new_names_joints_that_are_set_aside_for_one_reason_in_one_line(tmp_path, capsys):
    assert cli.run(["new", str(ROOT / "tests" / "models" / "own.xml"), "--out", str(tmp_path / "own.yaml")]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if "part of the arm" in line]
    assert said == ["2 joints are not part of the arm, since each is prismatic: slide_l, slide_r"]


@pytest.mark.parametrize("words", [["arm.urdf"], ["mine.yaml", "--force", "--by-hand"], ["--out", "other.yaml"]])
def test_new_asks_nothing_where_the_bus_is_not_there(folder, tmp_path, words):
    """Answers would be lost. The bus is looked at first, on a terminal as on a pipe."""
    shutil.copy(folder / "arm.urdf", tmp_path)
    master, slave = pty.openpty()
    shutil.copy(bundled_arms()["sarcos"], tmp_path / "mine.yaml")
    command = [sys.executable, "-m", "armlink.cli", "new", *words, "--bus", "socketcan:no_such_bus"]
    done = subprocess.run(command, stdin=slave, capture_output=True, text=True, cwd=tmp_path, timeout=60, check=False)
    os.close(master)
    os.close(slave)
    assert done.returncode == 3
    assert "cannot open it" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_new_does_not_ask_to_replace_a_file_by_a_model_that_is_not_there(tmp_path):
    (tmp_path / "arm.yaml").write_text("name: arm\n")
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "armlink.cli", "new", "arm.urdf"]
    done = subprocess.run(command, stdin=slave, capture_output=True, text=True, cwd=tmp_path, timeout=60, check=False)
    os.close(master)
    os.close(slave)
    assert done.returncode == 2
    assert done.stderr == "armlink: there is no model file arm.urdf: give the path of a URDF or MJCF file\n"
