"""Discovery: every family's drives are found by frames that only read, and nothing else on the bus is commanded."""

import json
import re
from types import SimpleNamespace

import pytest
import yaml
from bench import Bench

from armlink.arm_file import bundled_arms
from armlink.bus.open import parse_bus, resolve_bus
from armlink.bus.port import EXTENDED, REMOTE
from armlink.cli import run
from armlink.drives.cubemars.drives import find_drives as heard_cubemars
from armlink.drives.discovery import BusDrives
from armlink.drives.moteus.frames import READ, unpack
from armlink.drives.odrive.drives import find_drives as heard_odrives
from armlink.drives.odrive.frames import Heartbeat, Message, identifier, pack
from sim_bus.bus.lock_step import LockStepBus

ARMS = ["six-cia402", "openarm", "six-robstride", "six-moteus", "six-odrive", "six-myactuator"]
"""Of the families whose drives have ids; Piper's joints have none."""


def reads(can_id: int, data: bytes) -> bool:
    """Whether a frame only reads, in the family whose identifier it has; independent of what made it."""
    number = can_id & 0x1FFFFFFF
    if can_id & REMOTE:
        return number & 0x1F == 0 and number < 0x7E0
    if can_id & EXTENDED and number >> 8 == 0x80:  # moteus, a reply wanted
        return all(each.kind == READ for each in unpack(data)) and data[0] & 0xF0 == 0x10
    if can_id & EXTENDED:  # RobStride
        return number >> 24 == 17 or (number >> 8 == 0xFD and data == bytes(8))
    if number == 0x7FF:  # Damiao: read, and refresh
        return data[2] in (0x33, 0xCC)
    if 0x141 <= number <= 0x160:  # MyActuator: angle, version, model
        return data[0] in (0x92, 0xB2, 0xB5)
    return 0x601 <= number <= 0x67F and data[0] in (0x40, 0x60, 0x70)  # SDO upload


@pytest.fixture
def sent(monkeypatch):
    """All frames that a host sends on the simulated bus."""
    frames, put = [], LockStepBus.put

    def noted(self, can_id, data):
        frames.append((can_id, bytes(data)))
        put(self, can_id, data)

    monkeypatch.setattr(LockStepBus, "put", noted)
    return frames


def wired(folder, arm: str, change=lambda drives: None) -> list[dict]:
    """The file there.yaml: a bundled arm whose ids stand in reverse order; keys of its drives."""
    content = yaml.safe_load(bundled_arms()[arm].read_text())
    if arm == "openarm":
        content["kinematics"]["model"] = str(bundled_arms()[arm].parent / content["kinematics"]["model"])
    drives = [joint["drive"] for joint in content["link"]["joints"]]
    key = "node" if "node" in drives[0] else "id"
    for drive, other in zip(drives, [drive[key] for drive in reversed(drives)], strict=True):
        drive[key] = other
    change(drives)
    (folder / "there.yaml").write_text(yaml.safe_dump(content))
    return sorted(drives, key=number)


def number(drive: dict) -> int:
    return drive.get("id", drive.get("node"))


def scanned(capsys, status: int = 0) -> tuple[list[dict], str]:
    assert run(["scan", "--bus", "armlink_sim:there.yaml", "--json", "-"]) == status
    captured = capsys.readouterr()
    return json.loads(captured.out)["nodes"], captured.err


@pytest.mark.parametrize("arm", ARMS)
def test_shuffled_ids_are_found_but_for_a_drive_without_power_and_its_file_passes(
    arm, tmp_path, monkeypatch, capsys, sent
):
    monkeypatch.chdir(tmp_path)
    drives, began = wired(tmp_path, arm), LockStepBus.__init__

    def lacking(self, *args, **options):
        began(self, *args, **options)
        if arm != "six-cia402":
            self.arm.device(2).unplugged = True

    monkeypatch.setattr(LockStepBus, "__init__", lacking)
    if arm != "six-cia402":
        drives.remove(yaml.safe_load((tmp_path / "there.yaml").read_text())["link"]["joints"][2]["drive"])
    found, told = scanned(capsys)
    kind = drives[0]["family"]
    assert [each["family"] for each in found] == [kind] * len(drives)
    if kind == "damiao":
        assert [each["reply"] for each in found] == [drive["reply"] for drive in drives]
        assert all(drive["model"] in each["model"].split(" or ") for each, drive in zip(found, drives, strict=True))
    if kind == "robstride":
        assert [each["model"] for each in found] == [drive["model"] for drive in drives]
    assert kind in told.partition(";")[0]
    assert run(["new", "--out", "found.yaml", "--bus", "armlink_sim:there.yaml"]) == 0
    assert all(reads(*frame) for frame in sent)
    written = yaml.safe_load((tmp_path / "found.yaml").read_text())["link"]["joints"]
    assert [number(each["drive"]) for each in written] == [number(drive) for drive in drives]
    assert run(["check", "found.yaml", "--passive"]) == 0


def test_a_reply_id_as_delivered_and_one_on_another_s_command_id_are_named(tmp_path, monkeypatch, capsys, sent):
    monkeypatch.chdir(tmp_path)

    def change(drives):
        drives[0]["reply"], drives[1]["reply"] = 0, 0x04

    wired(tmp_path, "six-damiao", change)
    found, _ = scanned(capsys)
    wrong = {each["address"]: each["wrong"] for each in found if each["wrong"]}
    assert wrong == {
        "id 06h": "answers come on 00h, the value as delivered: set another reply id in it (register 7)",
        "id 05h": "answers come on 04h, on which id 04h takes commands: set another reply id in it (register 7)",
    }
    asked = [data[3] for can_id, data in sent if can_id == 0x7FF and data[0] == 5]
    assert asked == [8]  # its answer commands another: it is asked no more
    assert run(["new", "--out", "found.yaml", "--bus", "armlink_sim:there.yaml"]) == 0
    assert "id 06h: answers come on 00h" in capsys.readouterr().err
    written = yaml.safe_load((tmp_path / "found.yaml").read_text())["link"]["joints"]
    assert [each["drive"]["id"] for each in written] == [1, 2, 3, 4, 6]
    assert run(["check", "found.yaml", "--passive"]) == 0


def test_an_id_given_twice_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    wired(tmp_path, "six-robstride")
    put = LockStepBus.put

    def twice(self, can_id, data):
        put(self, can_id, data)
        if can_id == 0xFD04 | EXTENDED:
            put(self, can_id, data)

    monkeypatch.setattr(LockStepBus, "put", twice)
    assert run(["scan", "--bus", "armlink_sim:there.yaml"]) == 3
    assert "motor 4 answers twice" in capsys.readouterr().err
    assert run(["new", "--out", "found.yaml", "--bus", "armlink_sim:there.yaml"]) == 3


@pytest.mark.parametrize("arm", ["six-damiao", "six-robstride", "six-cubemars", "six-myactuator"])
def test_what_is_asked_of_all_families_commands_no_drive(arm, sent):
    """All requests to a bus on which nothing answers, heard by drives that have power."""
    told = BusDrives(LockStepBus(arm=Bench("six-cubemars").arm)).told
    assert told == "looked for canopen, cubemars, damiao, moteus, myactuator, odrive, piper, robstride"
    assert {0x7FF, 0x601, 0x141, 0x160, 0xFD01 | EXTENDED, 0x8001 | EXTENDED} <= {can_id for can_id, _ in sent}
    disturbed(arm, sent)


def test_families_that_are_not_asked_for_one_reason_are_named_together():
    told = BusDrives(LockStepBus(arm=Bench("six-cia402").arm)).told
    assert told.count("requests to them could command the canopen drives") == 1
    assert "not for damiao, myactuator (requests to them" in told


def disturbed(arm: str, frames) -> None:
    bench = Bench(arm)
    bench.set_up()
    assert bench.walk()
    before = [dict(vars(each)) for each in bench.simulated]
    calls = []
    for each in bench.simulated:
        each.motor.impede = each.motor.free = lambda *args: calls.append(args)
    for can_id, data in frames:
        bench.arm.on_frame(can_id, data)
    assert not calls
    assert [getattr(each, "command", None) for each in bench.simulated] == [each.get("command") for each in before]


@pytest.mark.parametrize("arm", ["six-moteus", "six-odrive"])
def test_register_requests_of_damiao_stop_no_moteus_controller_that_was_not_found(arm, sent):
    """The bus was opened without CAN FD, or the ODrives send no heartbeat."""
    bus = LockStepBus(arm=Bench("six-cubemars").arm)
    bus.fd = False
    assert "moteus (the bus is classical CAN" in BusDrives(bus).told
    disturbed(arm, sent)


def test_beside_a_family_that_its_requests_command_none_is_asked(tmp_path, monkeypatch, capsys, sent):
    monkeypatch.chdir(tmp_path)

    def change(drives):
        for place, drive in enumerate(drives):
            drive["node"] = 48 + place

    wired(tmp_path, "six-odrive", change)
    found, told = scanned(capsys)
    assert [each["address"] for each in found] == [f"node {48 + place}" for place in range(6)]
    assert re.search(r"not for .*canopen.* \(requests to them could command the odrive drives, or look like", told)
    assert not [can_id for can_id, _ in sent if can_id == 0x7FF or 0x601 <= can_id <= 0x67F]


def test_a_piper_is_no_odrive_axis(tmp_path, monkeypatch, capsys):
    """Its status comes on the identifier of a heartbeat of node 21, with values that one may have."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.yaml").write_text(bundled_arms()["six-piper"].read_text())
    found, _ = scanned(capsys)
    assert [(each["family"], each["address"]) for each in found] == [("piper", f"joint {n}") for n in range(1, 7)]


def test_a_heartbeat_is_no_other_device_s_frame():
    beat = (identifier(5, Message.HEARTBEAT), pack(Message.HEARTBEAT, *Heartbeat(0, 1)))
    other = [(0x181, b"\x37\x02" + bytes([n, 0, 0, 0, 200, 0])) for n in range(3)]
    new = (identifier(0x3F, Message.HEARTBEAT), beat[1])
    found = heard_odrives(SimpleNamespace(heard=[beat, beat, *other, new, new, (0x701, b"\x05"), (0x701, b"\x05")]))
    assert [(each.node, each.drive is None) for each in found] == [(5, False), (63, True)]
    assert heard_odrives(SimpleNamespace(heard=[beat])) == []


def test_cubemars_drives_are_heard_beside_their_host_and_never_asked():
    talk = [(3, bytes(8)), (0, bytes([3]) + bytes(7)), (0, b"\x00\x00"), (0, bytes([9]) + bytes(7)), (0x80, b"")]
    found = heard_cubemars(SimpleNamespace(heard=talk))
    assert [(each.address, each.reply, each.drive) for each in found] == [("id 03h", 0, None)]
    assert "by hand" in found[0].note


def test_two_bit_rates_are_those_of_can_fd():
    bus = parse_bus("socketcan:can0@1000000/5000000")
    assert (bus.bitrate, bus.fd, bus.options) == (1_000_000, True, {"data_bitrate": 5_000_000})
    assert resolve_bus("socketcan:can1@1000000/5000000", parse_bus("socketcan:can0")).fd
    for wrong in ("a:b@1000000/", "a:b@/5", "a:b@1/x"):
        with pytest.raises(Exception, match="expected bits per second"):
            parse_bus(wrong)


@pytest.mark.parametrize("arm", ARMS[1:])
def test_every_drive_tells_where_it_stands(arm, sent):
    bench = Bench(arm)
    found = BusDrives(LockStepBus(arm=bench.arm))
    told = list(found.positions().values())
    assert told == pytest.approx([each.motor.position for each in bench.simulated], abs=2e-3)
    assert all(reads(*frame) for frame in sent)


@pytest.mark.parametrize("arm", ARMS[1:])
def test_what_came_while_a_person_turned_a_joint_does_not_tell_where_it_is(arm):
    bench = Bench(arm)
    bus = LockStepBus(arm=bench.arm)
    found = BusDrives(bus)
    found.positions()
    waiting = bus.open_port()
    for _ in range(100):
        bench.arm.turn_by_hand(2, 0.1)
        waiting.receive(0.005)
    bench.arm.turn_by_hand(2, 0.9)
    told = list(found.positions().values())
    assert told == pytest.approx([each.motor.position for each in bench.simulated], abs=2e-2)
