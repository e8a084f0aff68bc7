"""What a user gets wrong costs one line and exit status 2, a missing bus 3; never a traceback or half a result.

The real commands, called in this process as the console script calls them.
"""

from pathlib import Path

import pytest

from armlink import cli
from armlink.arm_file import bundled_arms

SARCOS = bundled_arms()["sarcos"]
NOT_THERE = "socketcan:nosuch0"


def takes_arm(folder: Path, arm: str) -> dict[str, list[str]]:
    """Each command that takes an arm file, with what else it needs."""
    poses = folder / "poses.csv"
    poses.write_text(",".join(f"q_{i}" for i in range(1, 8)) + "\n" + ",".join("0" * 7) + "\n")
    out = ["--out", str(folder / "out")]
    return {
        "demo": ["--arm", arm, *out],
        "sim": [arm, "--bus", NOT_THERE],
        "scan": [arm, "--bus", NOT_THERE],
        "monitor": [arm, "--bus", NOT_THERE],
        "sweep": [arm, "--bus", NOT_THERE, *out],
        "verify": [arm, "--bus", NOT_THERE],
        "torque": [arm, "--q", str(poses)],
        "history": [arm, "--store", str(folder / "store.db")],
        "rollback": [arm, "--to", "12345678", "--store", str(folder / "store.db")],
    }


COMMANDS = sorted(takes_arm(Path("/tmp"), "arm.yaml"))
ON_A_BUS = ["sim", "scan", "monitor", "sweep", "verify"]


def fails(arguments: list[str], status: int, capsys: pytest.CaptureFixture[str]) -> str:
    """Run it, expect that status, and return the one line."""
    assert cli.run(arguments) == status, capsys.readouterr().err
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("armlink: "), err
    assert err.count("\n") == 1, err
    return err


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("name: joint_3, a: 0.0", "name: joint_3, a: wide", ["kinematics.joints.2.a", "wide"]),
        ("rate: 250", "rate: 250\n  speed: 3", ["link.speed", "unknown key"]),
        ("name: joint_7, node: 7", "name: joint_7, node: 6", ["link", "6"]),
        ("upper: 1.9198621772", "upper: -3.0", ["joint_1", "-3.0"]),
        ("kinematics:", "kinematics: [", ["not YAML"]),
    ],
    ids=["type", "unknown key", "node twice", "empty range", "not YAML"],
)
def test_a_malformed_arm_file(command, old, new, words, tmp_path, capsys):
    text = SARCOS.read_text()
    assert old in text
    arm = tmp_path / "arm.yaml"
    arm.write_text(text.replace(old, new, 1))
    line = fails([command, *takes_arm(tmp_path, str(arm))[command]], 2, capsys)
    assert "arm.yaml" in line
    for word in words:
        assert word in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", COMMANDS)
def test_an_arm_file_that_is_not_there(command, tmp_path, capsys):
    line = fails([command, *takes_arm(tmp_path, "nosuch.yaml")[command]], 2, capsys)
    assert "nosuch.yaml" in line
    assert "sarcos" in line


@pytest.mark.parametrize("command", ON_A_BUS)
def test_a_bus_that_does_not_exist(command, tmp_path, capsys):
    assert "nosuch0" in fails([command, *takes_arm(tmp_path, "sarcos")[command]], 3, capsys)


@pytest.mark.parametrize("command", ON_A_BUS)
@pytest.mark.parametrize("bus", ["vcan0", "socketcan:", ":vcan0", "socketcan:vcan0@fast"])
def test_a_bus_that_is_misspelt(command, bus, tmp_path, capsys):
    arguments = takes_arm(tmp_path, "sarcos")[command]
    arguments[arguments.index(NOT_THERE)] = bus
    assert "INTERFACE:CHANNEL" in fails([command, *arguments], 2, capsys)


@pytest.mark.parametrize("command", COMMANDS)
def test_an_option_that_does_not_exist(command, tmp_path, capsys):
    line = fails([command, *takes_arm(tmp_path, "sarcos")[command], "--nosuch"], 2, capsys)
    assert "--nosuch" in line


def recording(path: Path, columns: str) -> Path:
    rows = "\n".join(",".join(f"{0.01 * k}" for _ in columns.split(",")) for k in range(50))
    path.write_text(f"{columns}\n{rows}\n")
    return path


JOINTS = range(1, 8)
POSITIONS = ",".join(f"q_{i}" for i in JOINTS)
TORQUES = ",".join(f"tau_{i}" for i in JOINTS)


@pytest.mark.parametrize(
    ("columns", "word"),
    [
        (f"{POSITIONS},{TORQUES}", "t"),
        (f"t,{POSITIONS.replace('q_4,', '')},{TORQUES}", "q_4"),
        (f"t,{POSITIONS},{TORQUES.replace('tau_2,', '')}", "tau_2"),
        (f"t,{POSITIONS}", "tau"),
    ],
    ids=["no time", "a position", "a torque", "no torque at all"],
)
@pytest.mark.parametrize("role", ["train", "heldout"])
def test_a_recording_with_a_missing_column(columns, word, role, tmp_path, capsys):
    bad = recording(tmp_path / "bad.csv", columns)
    good = recording(tmp_path / "good.csv", f"t,{POSITIONS},{TORQUES}")
    files = {"train": good, "heldout": good, role: bad}
    arguments = [
        "gap",
        "diagnose",
        "--sim",
        "sarcos",
        "--train",
        str(files["train"]),
        "--heldout",
        str(files["heldout"]),
    ]
    line = fails(arguments, 2, capsys)
    assert "bad.csv" in line
    assert word in line


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet", ".mcap"])
def test_a_recording_that_is_not_what_its_name_says(suffix, tmp_path, capsys):
    bad = tmp_path / f"bad{suffix}"
    bad.write_bytes(b"\x00\x01 nothing of the kind\n")
    assert bad.name in fails(["gap", "diagnose", "--sim", "sarcos", "--train", str(bad)], 2, capsys)


def test_a_recording_that_is_not_there(tmp_path, capsys):
    assert "gone.csv" in fails(["gap", "diagnose", "--sim", "sarcos", "--train", "gone.csv"], 2, capsys)


@pytest.mark.parametrize(
    "text", ["", "<mujoco><worldbody>", "<robot name='x'/>"], ids=["empty", "cut off", "no joints"]
)
def test_a_model_that_cannot_be_read(text, tmp_path, capsys):
    model = tmp_path / "model.xml"
    model.write_text(text)
    good = recording(tmp_path / "good.csv", f"t,{POSITIONS},{TORQUES}")
    assert "model.xml" in fails(["gap", "diagnose", "--sim", str(model), "--train", str(good)], 2, capsys)


@pytest.mark.parametrize("command", ["calibrate", "identify"])
def test_a_folder_without_a_sweep(command, tmp_path, capsys):
    assert str(tmp_path) in fails([command, str(tmp_path)], 2, capsys)
    assert "nosuch" in fails([command, str(tmp_path / "nosuch")], 2, capsys)
