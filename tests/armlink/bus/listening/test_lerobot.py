"""The servos of a LeRobot program, heard while its own loop runs: Feetech and Dynamixel, by their makers' SDKs."""

import importlib
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from servo_bench import ServoBench

from armlink import lerobot
from armlink.arm_file import parse_arm
from armlink.bus.listening.lerobot import ROBOTS
from armlink.bus.listening.servo_lines import MODELS, accesses, packets
from armlink.bus.open import open_link_bus
from armlink.errors import BadInput
from armlink.link.listener import Listener

IDS = [1, 2, 3, 4, 5, 6]
KINDS = {"feetech": ("so101_follower", "scservo_sdk", 0), "dynamixel": ("koch_follower", "dynamixel_sdk", 2.0)}
PATIENCE_MS = 20_000
"""The SDKs' own patience of some 40 ms is too short on a busy machine."""
TICK = 2 * np.pi / 4096


class Loop:
    """What LeRobot does with a robot of six servos: positions by one group read, goals by one group write."""

    def __init__(self, kind: str, port: str) -> None:
        _, module, protocol = KINDS[kind]
        self.sdk = pytest.importorskip(module, reason="the makers' SDKs are not installed")
        self.model = MODELS["sts3215" if kind == "feetech" else "xl330-m288"]
        self.port, packet = self.sdk.PortHandler(port), self.sdk.PacketHandler(protocol)
        assert self.port.setBaudRate(1_000_000)
        self.port.setPacketTimeout = lambda size: self.port.setPacketTimeoutMillis(PATIENCE_MS)
        self.reads = self.sdk.GroupSyncRead(self.port, packet, 0, 1)
        self.writes = self.sdk.GroupSyncWrite(self.port, packet, self.model.target.address, self.model.target.size)

    def read(self, register: Any) -> list[int]:
        self.reads.clearParam()
        self.reads.start_address, self.reads.data_length = register.address, register.size
        for servo in IDS:
            self.reads.addParam(servo)
        assert self.reads.txRxPacket() == 0
        return [self.reads.getData(servo, register.address, register.size) for servo in IDS]

    def write(self, ticks: int) -> None:
        self.writes.clearParam()
        for servo in IDS:
            self.writes.addParam(servo, list(ticks.to_bytes(self.model.target.size, "little")))
        assert self.writes.txPacket() == 0


@pytest.fixture
def shared(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """pyserial and the SDKs are as before after the test; sockets lie in a folder of this test, whose path is short."""
    serial = pytest.importorskip("serial")
    folder = Path(tempfile.mkdtemp())
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    for name in ("read", "write"):
        monkeypatch.setattr(serial.Serial, name, getattr(serial.Serial, name))
    monkeypatch.setattr(serial.Serial, "armlink_copies", {}, raising=False)
    monkeypatch.delattr(serial.Serial, "armlink_copies")
    for _, module, _ in KINDS.values():
        sdk = pytest.importorskip(module, reason="the makers' SDKs are not installed")
        monkeypatch.setattr(sdk.GroupSyncRead, "txPacket", sdk.GroupSyncRead.txPacket)
    yield folder
    shutil.rmtree(folder)


def arm(kind: str, **keys: Any) -> Any:
    joints = [
        {"name": name, "node": servo, "rated_torque": 2.0, "max_torque": 2.0}
        for name, (servo, _) in ROBOTS[KINDS[kind][0]].items()
    ]
    stops = [{"name": each["name"], "lower": -3.2, "upper": 3.2, "a": 0.1} for each in joints]
    return parse_arm(
        {"name": "six", "kinematics": {"joints": stops}, "link": {"joints": joints} | keys}, Path("six.yaml")
    )


def bench_of(kind: str) -> ServoBench:
    """Servos at 100 ticks times their number, with a current of −10 counts times their number."""
    bench, model = ServoBench(IDS, kind == "dynamixel"), MODELS["sts3215" if kind == "feetech" else "xl330-m288"]
    for servo in IDS:
        bench.put(servo, model.position.address, (2048 + 100 * servo).to_bytes(model.position.size, "little"))
        count = 0x8000 | 10 * servo if kind == "feetech" else -10 * servo & 0xFFFF
        bench.put(servo, model.current.address, count.to_bytes(2, "little"))
    return bench


@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("currents", [False, True])
def test_the_loop_is_heard_and_goes_on_as_before(kind: str, currents: bool, shared: Path) -> None:
    name, described = KINDS[kind][0], arm(kind)
    with bench_of(kind) as bench:
        lerobot.share_lines(currents)
        loop = Loop(kind, bench.port)
        with Listener(described, open_link_bus(f"lerobot:{name}:{bench.port}", described.require_link())) as listener:
            for k in range(6):
                assert loop.read(loop.model.position) == [2048 + 100 * servo for servo in IDS]
                loop.write(2048 + k)
            found = []
            while (sample := listener.next(0.05)) is not None:
                found.append((sample, listener.position_sent))
        loop.port.closePort()
    assert len(found) >= 3  # a row ends with the next, and a sample with the one after
    sample, target = found[1]
    np.testing.assert_allclose(sample.position, 100 * TICK * np.array(IDS))
    np.testing.assert_allclose(target, target[0])
    assert target[0] / TICK == pytest.approx(round(target[0] / TICK))
    if not currents:
        assert np.isnan(sample.torque).all()
        return
    units = [MODELS[model] for _, model in ROBOTS[name].values()]
    expected = [
        np.nan if each.current is None else -10 * servo * each.current.unit * each.torque_constant
        for servo, each in zip(IDS, units, strict=True)
    ]
    np.testing.assert_allclose(sample.torque, expected)


@pytest.mark.parametrize("kind", list(KINDS))
def test_currents_that_the_loop_reads_itself_belong_to_the_nearest_positions(kind: str, shared: Path) -> None:
    described = arm(kind)
    with bench_of(kind) as bench:
        lerobot.share_lines()
        loop = Loop(kind, bench.port)
        channel = f"lerobot:{KINDS[kind][0]}:{bench.port}"
        with Listener(described, open_link_bus(channel, described.require_link())) as listener:
            for _ in range(6):
                loop.read(loop.model.position)
                loop.read(loop.model.current)
            found = []
            while (sample := listener.next(0.05)) is not None:
                found.append(sample)
        loop.port.closePort()
    assert np.isfinite([each.torque[5] for each in found]).any()


def test_the_bytes_on_the_line_are_those_without_a_listener(shared: Path) -> None:
    """Structure of the proof that nothing is sent: the servos hear the same bytes with copies, and with a listener."""
    heard = []
    for listens in (False, True):
        with bench_of("feetech") as bench:
            if listens:
                lerobot.share_lines()
            loop, described = Loop("feetech", bench.port), arm("feetech")
            bus = open_link_bus(f"lerobot:so101_follower:{bench.port}", described.require_link()) if listens else None
            for k in range(5):
                loop.read(loop.model.position)
                loop.write(2048 + k)
            loop.read(loop.model.position)
            if bus is not None:
                bus.shutdown()
            loop.port.closePort()
            heard.append(bytes(bench.heard))
    assert heard[0] == heard[1]


def test_a_listener_that_does_not_read_holds_up_nobody(shared: Path) -> None:
    described = arm("feetech")
    with bench_of("feetech") as bench:
        lerobot.share_lines()
        loop = Loop("feetech", bench.port)
        bus = open_link_bus(f"lerobot:so101_follower:{bench.port}", described.require_link())
        for _ in range(200):  # more than a socket holds
            loop.write(2048)
        loop.port.closePort()
        bus.shutdown()


def test_the_command_runs_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any, shared: Path) -> None:
    script = tmp_path / "teleoperate.py"
    script.write_text("import sys\nprint(__name__, sys.argv[1:])\n")
    monkeypatch.setattr(sys, "argv", [])
    lerobot.main([str(script), "--robot.type=so101_follower"])
    assert capsys.readouterr().out == "__main__ ['--robot.type=so101_follower']\n"
    with pytest.raises(SystemExit, match="there is no such command"):
        lerobot.main(["no-such-command"])


@pytest.mark.parametrize("channel", ["so101_follower", "so101_follower:", "nothing:/dev/ttyACM0"])
def test_a_robot_that_is_none(channel: str) -> None:
    with pytest.raises(BadInput, match="expected TYPE:PORT"):
        open_link_bus(f"lerobot:{channel}", arm("feetech").require_link())


def test_nobody_runs_the_robot(shared: Path) -> None:
    described = arm("feetech")
    bus = open_link_bus("lerobot:so101_follower:/dev/ttyACM7", described.require_link())
    with Listener(described, bus) as listener:
        assert listener.next(0.02) is None
        assert "python -m armlink.lerobot" in bus.silence()
    assert not list(shared.rglob("*.sock"))


@given(st.binary(max_size=200), st.binary(max_size=200))
def test_any_bytes_may_come(request: bytes, answer: bytes) -> None:
    accesses(b"\xff\xff\xfd\x00" + request, answer)
    accesses(b"\xff\xff" + request, b"\xff\xff" + answer)


def test_packets_of_the_manuals() -> None:
    """Ping of Dynamixel protocol 2.0 (e-Manual, 5.2), and the read of a position (Feetech, communication manual)."""
    (ping,) = packets(bytes.fromhex("fffffd00010300011 94e".replace(" ", "")))
    assert (ping.id, ping.instruction) == (1, 1)
    ((servo, address, data),), _ = accesses(bytes.fromhex("ffff0104023802be"), bytes.fromhex("ffff0104001805dd"))
    assert (servo, address, data) == (1, 0x38, b"\x18\x05")


def test_stuffed_bytes_are_taken_out() -> None:
    bench = importlib.import_module("servo_bench")
    body = bytes((0x55, 0)) + b"\xff\xff\xfd\xfd\x01"
    line = b"\xff\xff\xfd\x00\x01" + (len(body) + 2).to_bytes(2, "little") + body
    (found,) = packets(line + bench.crc(line).to_bytes(2, "little"))
    assert found.parameters == b"\x00\xff\xff\xfd\x01"
