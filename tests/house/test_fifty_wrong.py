"""Fifty wrong files, options and buses: one line each, which names the thing and the remedy."""

import gzip
import re
from pathlib import Path

import pytest

from armlink import cli
from armlink.arm_file import bundled_arms

SARCOS = bundled_arms()["sarcos"].read_text()
MODELS = Path(__file__).parents[1] / "models"
Q = ",".join(f"q_{i}" for i in range(1, 8))
TAU = ",".join(f"tau_{i}" for i in range(1, 8))
GAP = ["gap", "diagnose", "--sim", "sarcos", "--train"]


def edited(old: str, new: str):
    """The bundled arm with one edit."""

    def write(folder: Path) -> None:
        assert old in SARCOS
        (folder / "arm.yaml").write_text(SARCOS.replace(old, new, 1))

    return write


def model(old: str, new: str, file: str = "arm4.urdf"):
    """A model with one edit."""

    def write(folder: Path) -> None:
        text = (MODELS / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new, 1))

    return write


def table(header: str, rows: int = 50, cell: str = "{0}"):
    """A recording with this header."""

    def write(folder: Path) -> None:
        lines = [",".join([f"{k * 0.01}"] * len(header.split(","))) for k in range(rows)]
        (folder / "run.csv").write_text("\n".join([header, *lines]).replace("0.02,", cell.format("0.02,"), 1) + "\n")

    return write


def nothing(folder: Path) -> None:
    """No file at all."""


ARM = ["scan", "arm.yaml"]
NEW = ["new", "arm4.urdf", "--out", "made.yaml"]
WRONG = [
    # arm files: typos
    (edited("rated_torque: 130.0", "rated_torqe: 130.0"), ARM, ["rated_torqe", "did you mean rated_torque?"]),
    (edited("max_torque_rate: 400.0", "torque_rate_max: 400.0"), ARM, ["did you mean max_torque_rate?"]),
    (edited("kinematics:", "kinematic:"), ARM, ["did you mean kinematics?"]),
    (edited("gravity:", "gravitation:"), ARM, ["gravitation", "did you mean gravity?"]),
    (edited("alpha:", "aplha:"), ARM, ["aplha", "did you mean alpha?"]),
    (edited("bitrate:", "bit_rate:"), ARM, ["did you mean bitrate?"]),
    (edited("link:\n", "link:\n  deadlin: 0.1\n"), ARM, ["did you mean deadline?"]),
    (edited("com:", "centre:"), ARM, ["sim.links.0.centre", "unknown key"]),
    (edited("friction.coulomb", "friction.coulom"), ARM, ["friction.coulom"]),
    (edited("name: sarcos", "name: sarcos\nsweep: {setps: 6}"), ARM, ["sweep.setps", "did you mean steps?"]),
    # arm files: units and values
    (edited("rated_torque: 130.0", "rated_torque: 130 Nm"), ARM, ["130 Nm", "without 'Nm'"]),
    (edited("rate: 250", "rate: 250 Hz"), ARM, ["link.rate", "without 'Hz'"]),
    (edited("upper: 1.9198621772", "upper: 110 deg"), ARM, ["upper", "without 'deg'"]),
    (edited("max_torque: 180.0", "max_torque: -180.0"), ARM, ["max_torque", "greater than 0"]),
    (edited("node: 1,", "node: 200,"), ARM, ["node", "127"]),
    (edited("bitrate: 1000000", "bitrate: 0"), ARM, ["bitrate", "greater than 0"]),
    (edited("gravity: [9.81, 0.0, 0.0]", "gravity: 9.81"), ARM, ["gravity"]),
    (edited("gravity: [9.81, 0.0, 0.0]", "gravity: [9.81, 0.0]"), ARM, ["gravity", "3"]),
    (edited("mass: 8.0", "mass: 0.0"), ARM, ["sim.links.0.mass", "greater than 0"]),
    (edited("lower: -0.8726646260", "lower: 2.5"), ARM, ["joint_1", "lower 2.5 must be less"]),
    # arm files: missing parts
    (edited("name: joint_1, node: 1", "name: joint_1"), ARM, ["link.joints.0", "joint_1: give `node` or `drive"]),
    (edited("name: sarcos\n", ""), ARM, ["key name", "add it"]),
    (edited("interface: armlink_sim, channel: sarcos", "interface: armlink_sim, channel: nobody"), ARM, ["nobody"]),
    (edited("name: joint_2, node: 2", "name: joint_2, node: 1"), ARM, ["is given twice", "unique"]),
    (
        edited("name: joint_2, node", "name: shoulder, node"),
        ARM,
        ["shoulder", "give both the same names in the same order"],
    ),
    (edited("kinematics:", "kinematics: ["), ARM, ["not YAML"]),
    (lambda folder: (folder / "arm.yaml").write_text(""), ARM, ["is a mapping", "`name`, `kinematics` and `link`"]),
    (lambda folder: (folder / "arm.yaml").mkdir(), ARM, ["arm.yaml", "folder"]),
    (nothing, ["scan", "amr.yaml"], ["no arm file amr.yaml", "give a path"]),
    (nothing, ["scan", "sarcso"], ["did you mean sarcos?"]),
    (model("j1", "j1"), ["scan", "arm4.urdf"], ["is a model", "armlink new arm4.urdf"]),
    # models
    (nothing, NEW, ["no model file arm4.urdf", "give the path"]),
    (model("<robot", "<robto"), NEW, ["arm4.urdf", "not a URDF or MJCF"]),
    (model('"j2" type="revolute"', '"j2" type="prismatic"'), NEW, ["j2 is prismatic", "--lock j2:POSITION"]),
    (model("j1", "j1"), [*NEW, "--tip", "l9"], ["--tip l9", "l4"]),
    (model("j1", "j1"), [*NEW, "--stops", "j4:2:1"], ["j4:2:1", "JOINT:LOWER:UPPER"]),
    (model("j1", "j1"), [*NEW, "--stops", "wrist:-1:1"], ["wrist", "j1, j2, j3, j4"]),
    (nothing, ["new", "arm.stl"], ["arm.stl", "expected a URDF or MJCF"]),
    # buses
    (nothing, ["scan", "--bus", "can0"], ["can0", "INTERFACE:CHANNEL"]),
    (nothing, ["scan", "--bus", "socketcan:nosuch0"], ["nosuch0"]),
    (nothing, ["scan", "--bus", "sokcetcan:can0"], ["sokcetcan", "does not know this interface"]),
    (nothing, ["scan", "sarcos", "--bus", "armlink_sim:parallel6"], ["no answer from joint_1 (node 1)"]),
    (nothing, ["check", "sarcos", "--bus", "armlink_sim:parallel6"], ["no answer"]),
    (nothing, ["sim", "sarcos", "--bus", "armlink_sim:sarcos"], ["choose another"]),
    # recordings, sweeps, options
    (nothing, [*GAP, "run.csv"], ["no recording run.csv", "give a"]),
    (table(f"t,{Q}"), [*GAP, "run.csv"], ["no torque channel", "tau_1"]),
    (table(f"t,{Q.replace('q_3,', '')},{TAU}"), [*GAP, "run.csv"], ["q_3"]),
    (table(f"{Q},{TAU}"), [*GAP, "run.csv"], ["t"]),
    (table("t,q_1,tau_1"), [*GAP, "run.csv"], ["7", "joint"]),
    (lambda folder: (folder / "run.csv.gz").write_bytes(gzip.compress(b"a,b\n1,2\n")), [*GAP, "run.csv.gz"], ["t"]),
    (nothing, ["calibrate", "unloaded"], ["unloaded"]),
    (nothing, ["calibrate"], ["directories"]),
    (nothing, ["sweep", "sarcos"], ["--out"]),
    (nothing, ["sweep", "sarcos", "--hold", "brake", "--plan"], ["--hold brake", "stops or servo"]),
    (nothing, ["convert", "run.csv", "run.xlsx"], ["run"]),
    (nothing, ["demo", "--seed", "one"], ["--seed", "integer"]),
]


@pytest.mark.parametrize(("write", "arguments", "words"), WRONG)
def test_one_line_names_the_thing_and_the_remedy(write, arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    write(tmp_path)
    status = cli.run(arguments)
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if line.startswith("armlink: ")]
    assert status in (2, 3), err
    assert "Traceback" not in err
    assert status == 3 or out == ""  # scan and check show what they found before a bus fault ends them
    assert len(lines) == 1
    for word in words:
        assert re.search(re.escape(word), lines[0]), lines[0]
    assert not (tmp_path / "made.yaml").exists()


def test_there_are_fifty():
    assert len(WRONG) >= 50
