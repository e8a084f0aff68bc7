"""Without extras: every command loads, works on what the core holds, and names the extra that it needs."""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from armlink.extras import REQUIREMENT, has_extra
from armlink.recording.files import save_recording
from armlink.recording.recording import Recording

ROOT = Path(__file__).parents[2]
EXTRAS = {
    "adapters": ("serial", "usb"),
    "bags": ("lz4", "mcap", "rosbags", "zstandard"),
    "cluster": ("cryptography", "dask", "distributed"),
    "daemon": ("fastapi", "prometheus_client", "uvicorn"),
    "foxglove": ("foxglove",),
    "parquet": ("pyarrow",),
    "postgresql": ("psycopg",),
    "reports": ("jinja2", "plotly"),
    "rerun": ("rerun",),
    "ros2": ("cyclonedds",),
    "simulator": ("msgpack",),
}
"""Extra → the modules that it alone brings."""
PACKAGES = {"foxglove": "foxglove-sdk", "rerun": "rerun-sdk", "serial": "pyserial", "usb": "gs-usb"}
"""Module → its package, where that has another name."""
WITHOUT = """
import sys
from importlib.abc import MetaPathFinder

ABSENT = {absent!r}

class Absent(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ABSENT:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
"""
CORE = """
from importlib.metadata import entry_points
for group in ("armlink.commands", "armlink.api", "armlink.drives", "armlink.sections"):
    for point in entry_points(group=group):
        point.load()
from armlink.loop.open import open_arm
from armlink.loop.process import DriveLoop
from calib.api import open_link
with open_link("sarcos", simulated=True) as link:
    link.start()
    link.enable()
"""


def run_without(extras, source: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run Python as if these extras were not installed."""
    absent = {module for extra in extras for module in EXTRAS[extra]}
    words = [sys.executable, "-c", WITHOUT.format(absent=absent) + source]
    return subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)


COMMANDS = """
import contextlib, io, json
from armlink import cli
for words in {words!r}:
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        status = cli.run(words)
    print(json.dumps([status, said.getvalue()]))
"""


def outcomes(extras, commands: list[list[str]], folder: Path, before: str = "") -> list[tuple[int, str]]:
    """Exit status and standard error of each command, in one interpreter, that has run something before."""
    done = run_without(extras, before + COMMANDS.format(words=commands), folder)
    assert done.returncode == 0, done.stderr
    return [tuple(json.loads(line)) for line in done.stdout.splitlines()]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One with a recording in CSV, and one of each suffix that is there to be read."""
    recording = Recording(t=np.arange(9) * 0.1, position=np.zeros((9, 3)), torque=np.ones((9, 3)))
    for suffix in (".csv", ".csv.gz", ".parquet", ".mcap"):
        save_recording(recording, tmp_path / f"run{suffix}")
    (tmp_path / "lerobot" / "meta").mkdir(parents=True)
    (tmp_path / "lerobot" / "meta" / "info.json").touch()
    return tmp_path


def test_the_core_and_its_commands_need_no_extra(folder):
    commands = [
        ["--help"],
        ["doctor", "sarcos"],
        ["drives"],
        ["sweep", "sarcos", "--plan"],
        ["convert", "run.csv", "other.csv.gz"],
        ["convert", "run.csv.gz", "other.csv"],
        ["gap", "plan", "sarcos", "--out", "motion.csv", "--joint", "joint_1"],
        ["history", "sarcos", "--store", "records.sqlite"],
    ]
    for words, (status, said) in zip(commands, outcomes(EXTRAS, commands, folder, CORE), strict=True):
        assert status == 0, (words, said)
        assert "not installed" not in said, words


NAMED = {
    "adapters": [
        (f"bus {interface}:none", ["scan", "--bus", f"{interface}:none"])
        for interface in ("damiao_serial", "gs_usb", "robstride_serial", "slcan")
    ],
    "bags": [
        ("run.mcap", ["convert", "run.mcap", "other.csv"]),
        ("other.mcap", ["convert", "run.csv", "other.mcap"]),
        ("other.mcap", ["record", "sarcos", "other.mcap", "--bus", "virtual:x"]),
        ("--out other.mcap", ["gap", "collect", "sarcos", "--motion", "m.csv", "--out", "other.mcap"]),
    ],
    "cluster": [("diagnose-fleet", ["gap", "diagnose-fleet", "."])],
    "daemon": [("daemon", ["daemon", "no-such-arm"])],
    "foxglove": [("--foxglove", ["monitor", "sarcos", "--bus", "virtual:x", "--foxglove", "0"])],
    "parquet": [
        ("run.parquet", ["convert", "run.parquet", "other.csv"]),
        ("other.parquet", ["convert", "run.csv", "other.parquet"]),
        ("lerobot", ["convert", "lerobot", "other.csv"]),
        ("--table", ["gap", "diagnose-fleet", ".", "--table", "t.parquet"]),
    ],
    "postgresql": [("record store postgresql+psycopg://u@h/d", ["history", "sarcos", "--store", "postgresql://u@h/d"])],
    "reports": [
        ("--report", ["calibrate", "no-such-sweeps", "--report", "r.html"]),
        ("--report", ["verify", "no-such-arm", "--report", "r.html"]),
        ("--picture", ["sweep", "no-such-arm", "--plan", "--picture", "p.html"]),
        ("--report", ["gap", "diagnose", "--sim", "s.xml", "--train", "t.csv", "--report", "r.html"]),
    ],
    "rerun": [("--rerun", ["monitor", "sarcos", "--bus", "virtual:x", "--rerun", "1"])],
    "ros2": [("bus ros2:/joint_states", ["monitor", "sarcos", "--once", "--ros2", "/joint_states"])],
    "simulator": [("bus udp_multicast:239.0.0.1", ["scan", "--bus", "udp_multicast:239.0.0.1"])],
}
"""Extra → commands that need it, with the purpose that their error begins with."""


@pytest.mark.sample(1)
@pytest.mark.parametrize("extra", EXTRAS)
def test_a_command_names_the_extra_that_it_needs(folder, extra):
    purposes, commands = zip(*NAMED[extra], strict=True)
    for purpose, (status, said) in zip(purposes, outcomes([extra], list(commands), folder), strict=True):
        before, _, remedy = said.partition(" is not installed: ")
        lines = {f"armlink: {purpose}: {module} (extra {extra})" for module in EXTRAS[extra]}
        assert (status, before in lines) == (2, True), said
        program, *install = shlex.split(remedy)
        assert (program, install[:3]) == (sys.executable, ["-m", "pip", "install"])
        packages = {each.partition(">")[0].partition("[")[0] for each in install[3:]}
        assert packages == {PACKAGES.get(module, module.replace("_", "-")) for module in EXTRAS[extra]}


def test_the_table_has_every_extra_of_the_project():
    from importlib.metadata import metadata

    known = set(metadata("armlink").get_all("Provides-Extra"))
    assert known - {"all", "demo", "dev", "notebooks"} == EXTRAS.keys()
    assert all(has_extra(extra) for extra in EXTRAS if extra not in ("adapters", "rerun"))
    assert REQUIREMENT.match('psycopg[binary]>=3.2; extra == "postgresql"')["extra"] == "postgresql"


@pytest.mark.parametrize("words", [["monitor", "sarcos", "--once"], ["daemon", "sarcos", "--state", "state"]])
def test_without_the_extra_a_ros_topic_cannot_be_heard(words, tmp_path):
    lacking = run_without(["ros2"], DEMO.format(words=[*words, "--ros2", "/joint_states"]), tmp_path)
    assert lacking.returncode == 2
    (line,) = lacking.stderr.splitlines()
    assert "cyclonedds (extra ros2) is not installed" in line


DEMO = "from armlink import cli\nsys.exit(cli.run({words!r}))"


def test_without_the_extra_that_draws_its_report_the_demo_does_not_begin(tmp_path):
    source = DEMO.format(words=["demo", str(ROOT / "examples" / "planar3.yaml"), "--out", "demo"])
    lacking = run_without(["reports"], source, tmp_path)
    assert lacking.returncode == 2
    assert "(extra reports) is not installed: " in lacking.stderr
    assert not (tmp_path / "demo").exists()


@pytest.mark.long
def test_the_demo_needs_no_other_extra(tmp_path):
    """The demo of a small arm in test_first_hour has no other either."""
    source = DEMO.format(words=["demo", str(ROOT / "examples" / "planar3.yaml"), "--out", "demo"])
    done = run_without(EXTRAS.keys() - {"reports"}, source, tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "demo" / "summary.json").read_text())["schema"] == "armlink.demo/1"
    assert {each.name for each in (tmp_path / "demo" / "data").glob("*.csv.gz")} == {"train.csv.gz", "heldout.csv.gz"}
