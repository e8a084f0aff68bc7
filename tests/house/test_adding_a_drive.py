"""docs/adding-a-drive.md adds a family: its files, as they stand there, are installed, simulated, checked, driven."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from armlink import contributed
from armlink.arm_file import load_arm
from armlink.cli import run
from armlink.drives.family import family
from armlink.drives.orders import Limits, Mode, Order, Power
from armlink.link.link import Link
from armlink.link.types import Command
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

PAGE = (Path(__file__).parents[2] / "docs" / "adding-a-drive.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r'^```\w+ title="(\S+)"\n(.*?)^```$', PAGE, re.MULTILINE | re.DOTALL))
MOST_LINES = 200


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The files of the page, found as an installed package's would be."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    info = tmp_path / "acme_drives-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-drives\nVersion: 0.1\n")
    points = re.findall(r'entry-points\."(\S+)"\]\n(\w+) = "(\S+)"', FILES["pyproject.toml"])
    (info / "entry_points.txt").write_text("".join(f"[{group}]\n{name} = {at}\n" for group, name, at in points))
    assert len(points) == 2
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    contributed.installed_entry_points.cache_clear()
    yield tmp_path
    import sys

    for module in ("acme", "acme_sim"):
        sys.modules.pop(module, None)
    family.cache_clear()
    contributed.installed_entry_points.cache_clear()


def test_it_is_short():
    code = FILES["acme.py"] + FILES["acme_sim.py"] + FILES["pyproject.toml"]
    assert len([line for line in code.splitlines() if line.strip()]) < MOST_LINES


def test_it_is_listed_found_checked_and_its_scales_judged(installed, capsys):
    assert run(["drives", "--json", "drives.json"]) == 0
    listed = json.loads((installed / "drives.json").read_text())
    assert any(each["family"] == "acme" and each["traits"]["silence"] == "holds" for each in listed)
    assert run(["scan", "pair.yaml", "--json", "scan.json"]) == 0
    assert [each["serial"] for each in json.loads((installed / "scan.json").read_text())["nodes"]] == ["1001", "1002"]
    assert run(["check", "pair.yaml", "--json", "check.json"]) == 0
    checks = json.loads((installed / "check.json").read_text())["checks"]
    silent = [each for each in checks if each["check"] == "silence"]
    assert [each["outcome"] for each in silent] == ["passed"] * 2
    assert all("holds within" in each["found"] for each in silent)
    assert run(["check", "pair.yaml", "--scales", "move"]) == 0


def test_it_is_driven_through_the_gate(installed):
    arm = load_arm("pair.yaml")
    sim = SimulatedArm(arm, Truth.of(arm))
    with Link(arm, LockStepBus(arm=sim)) as link:
        link.start()
        hold = Command.hold(link.enable().position)
        for _ in range(100):
            sample = link.cycle(hold)
        assert sample.position == pytest.approx(sim.plant.position, abs=2e-4)
        assert sample.torque == pytest.approx(sim.plant.motor_torque, abs=0.1)
        push = Command(np.full(2, Mode.TORQUE, np.int8), np.array([500.0, -500.0]), hold.position)
        for _ in range(5):
            link.cycle(push)
        assert np.abs(link.torque_sent).max() <= 25.0


def test_any_bytes_and_any_orders(installed):
    drives = family("acme").build(arm := load_arm("pair.yaml"), arm.link.joints)
    random = np.random.default_rng(0)
    drives.limits = [Limits(3.004, 100.0, 1.0, -1.23456, 1.2, 0.1, 0.004)] * 2
    for _ in range(3000):
        drives.take(int(random.integers(0x800)), random.bytes(int(random.integers(9))), 0.0)
        drives.take(0x200 + int(random.integers(1, 3)), bytes([1]) + random.bytes(7), 0.0)
        power, mode = random.choice(list(Power)), random.choice([Mode.TORQUE, Mode.POSITION])
        position, torque = random.uniform(-2, 2), random.uniform(-50, 50)
        drives.frames([Order(power, False, mode, position, 0.0, torque, 0.0, 0.0), None], 0.0)
        sent = drives.sent(0)
        if sent is not None and power is Power.ON:
            assert abs(sent.torque) <= 3.004
            if -1.23456 <= position <= 1.2:
                assert -1.23456 <= sent.position <= 1.2
    with pytest.raises(ValueError):
        drives.frames([Order(Power.ON, False, Mode.POSITION, np.nan, 0.0, 0.0, 0.0, 0.0), None], 0.0)
