"""An arm on two buses: the simulated one answers on both, the link and the scan take both as one."""

import threading

import can
import pytest
import yaml
from rig import Hand

from armlink.arm_file import load_arm
from armlink.bus.bus_group import BusGroup
from armlink.bus.in_process import InProcessBus
from armlink.bus.open import open_link_bus
from armlink.cli import run
from armlink.link.link import Link
from armlink.link.types import Command
from sim_bus.bus.server import ArmServer
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

NODES = (11, 12)


@pytest.fixture
def path(tmp_path):
    row = {"rated_torque": 20.0, "max_torque": 20.0}
    content = {
        "name": "pair",
        "kinematics": {
            "joints": [
                {"name": "base", "alpha": 1.5707963, "d": 0.2, "lower": -2.0, "upper": 2.0},
                {"name": "tip", "a": 0.3, "lower": -2.0, "upper": 2.0},
            ]
        },
        "link": {
            "bus": {"interface": "virtual", "channel": f"{tmp_path}/a"},
            "buses": {"tool": {"interface": "virtual", "channel": f"{tmp_path}/b"}},
            "joints": [{"name": "base", "node": 11, **row}, {"name": "tip", "node": 12, "bus": "tool", **row}],
        },
        "sim": {
            "links": [
                {"mass": 2.0, "com": [0.0, 0.0, 0.05], "inertia": [0.01, 0.01, 0.01]},
                {"mass": 1.0, "com": [0.1, 0.0, 0.0], "inertia": [0.01, 0.01, 0.01]},
            ],
            "sensors": {"noise": [0.01, 0.01], "bits": 16},
        },
    }
    (tmp_path / "pair.yaml").write_text(yaml.safe_dump(content))
    return tmp_path / "pair.yaml"


@pytest.fixture
def served(path):
    """The arm on both buses, served by a thread in lock-step with SYNC."""
    described = load_arm(path)
    arm = SimulatedArm(described, Truth.of(described))
    group = open_link_bus(None, described.require_link())
    server, done = ArmServer(arm, group, lockstep=True), threading.Event()

    def serve():
        while not done.is_set():
            server.turn()

    thread = threading.Thread(target=serve)
    thread.start()
    yield arm, described
    done.set()
    thread.join()
    group.shutdown()


@pytest.fixture
def no_waiting(monkeypatch):
    """The arm's turns, which come when the host waits, do not wait for the host."""
    monkeypatch.setattr("sim_bus.bus.server.TICK", 0.0)


class Pumped(InProcessBus):
    """A bus on which the simulated arm gets its turn whenever the host finds nothing there; no thread, no waiting."""

    def __init__(self, bus, turn):
        self.bus, self.port, self.turn = bus, bus.open_port(), turn

    def put(self, can_id, data):
        self.port.send(can_id, data)

    def take(self, timeout=0.0):
        frame = self.port.receive(0.0)
        if frame is None:
            self.turn()
            frame = self.port.receive(0.0)
        return frame

    def shutdown(self):
        self.bus.shutdown()


class ArmTime:
    """The simulated arm's time, which SYNC alone moves on."""

    def __init__(self, arm):
        self.arm = arm

    def now(self):
        return self.arm.time

    def sleep_until(self, instant):
        pass


def with_drives(path, *drives):
    """The arm with other drives: keys of both joints' drives, or None for a CANopen node of id 11."""
    content = yaml.safe_load(path.read_text())
    for row, drive in zip(content["link"]["joints"], drives, strict=True):
        del row["node"]
        row |= {"node": 11} if drive is None else {"drive": drive}
    path.write_text(yaml.safe_dump(content))
    return load_arm(path)


DAMIAO = {"family": "damiao", "id": 1, "reply": 17, "model": "DM4340", "kp": 40, "kd": 2}


@pytest.mark.usefixtures("no_waiting")
@pytest.mark.parametrize("repeated", [False, True])
def test_the_joints_of_both_buses_move_as_one_arm(path, repeated):
    described = with_drives(path, None, None) if repeated else load_arm(path)
    arm = SimulatedArm(described, Truth.of(described))
    nodes, host = (open_link_bus(None, described.require_link()) for _ in range(2))
    server = ArmServer(arm, nodes, lockstep=True, now=lambda: 0.0)
    pumped = BusGroup([Pumped(bus, server.turn) for bus in host.members], list(host.tags))
    pumped.clock = ArmTime(arm)
    with Link(described, pumped) as link:
        link.start()
        link.enable()
        command = Command.hold(link.position_sent)
        began, start = arm.time, link.position_sent
        for _ in range(100):
            command.position += [0.002, -0.001]
            sample = link.cycle(command)
        assert sample.position - start == pytest.approx([0.2, -0.1], abs=0.03)
        # SYNC comes on both buses, and is one period all the same
        assert arm.time - began == pytest.approx(100 * link.period, abs=3 * link.period)
        assert link.stats.missed == 0
    nodes.shutdown()


@pytest.mark.usefixtures("no_waiting")
@pytest.mark.parametrize("turned", [False, True])
def test_a_node_and_another_drive_on_two_buses_move_as_one_arm(path, turned):
    serials_of_an_arm_that_moves_as_one(path, *((DAMIAO, None) if turned else (None, DAMIAO)))


def test_frames_on_a_bus_without_nodes_reach_no_node_of_another(path):
    described, clock = with_drives(path, None, DAMIAO), Hand()
    arm = SimulatedArm(described, Truth.of(described))
    nodes, host = (open_link_bus(None, described.require_link()) for _ in range(2))
    server = ArmServer(arm, nodes, now=clock.now)
    server.turn()
    [node], port = arm.nodes, host.open_port()
    before = node.nmt, node.value(0x60FF)
    write = bytes.fromhex("23ff600001000000")
    for tag in host.tags.values():
        while port.receive(0.0) is not None:
            pass
        port.send(tag | 0x60B, write)  # to node 11, were it there
        port.send(tag, bytes([1, 0]))
        server.turn()
        found = list(iter(lambda: (port.receive(0.0) or (None,))[0], None))
        assert ((node.nmt, node.value(0x60FF)) == before) == (tag > 0)
        assert (0x58B in found) == (tag == 0)
        node.nmt = before[0]
        node._set((0x60FF, 0), bytes(4))
    host.shutdown()
    nodes.shutdown()


def serials_of_an_arm_that_moves_as_one(path, *drives):
    """Serial numbers on the buses of an arm of two joints, which follows its targets."""
    described, clock = with_drives(path, *drives), Hand()
    arm = SimulatedArm(described, Truth.of(described))
    nodes, host = (open_link_bus(None, described.require_link()) for _ in range(2))
    server = ArmServer(arm, nodes, now=clock.now)
    pumped = BusGroup([Pumped(bus, server.turn) for bus in host.members], list(host.tags))
    pumped.clock = clock
    with Link(described, pumped) as link:
        serials = {each.serial for each in link.scan()}
        link.start()
        start = link.enable().position
        command = Command.hold(start)
        for _ in range(100):
            command.position += [0.002, -0.001]
            clock.time += link.period
            sample = link.cycle(command)
        assert sample.position - start == pytest.approx([0.2, -0.1], abs=0.05)
        assert link.stats.missed == 0
    nodes.shutdown()
    return serials


@pytest.mark.usefixtures("no_waiting")
def test_drives_with_the_same_ids_on_two_buses_move_as_one_arm(path):
    assert len(serials_of_an_arm_that_moves_as_one(path, DAMIAO, DAMIAO)) == 2


def test_each_node_answers_on_its_own_bus_alone(served, path):
    heard = {}
    for name in "ab":
        with can.Bus(interface="virtual", channel=f"{path.parent}/{name}") as bus:
            for node in NODES:
                bus.send(can.Message(arbitration_id=0x600 + node, data=b"\x40\0\x10\0\0\0\0\0", is_extended_id=False))
            came = []
            while (message := bus.recv(0.5)) is not None:
                came.append(message.arbitration_id)
            heard[name] = [each for each in came if each & 0x780 == 0x580]
    assert heard == {"a": [0x58B], "b": [0x58C]}


def test_the_scan_finds_the_joints_of_both_buses(served, path, capsys):
    assert run(["scan", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "base" in shown
    assert "tip" in shown
    assert "no answer" not in shown
