"""The stock canopen package operates the simulated arm through a python-can bus."""

import threading
import time

import can
import canopen
import numpy as np
import pytest
import yaml

from armlink.arm_file import bundled_arms, parse_arm
from armlink.drives.canopen.eds_file import bundled_path
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth


@pytest.fixture
def network() -> canopen.Network:
    bus = can.Bus(interface="armlink_sim", channel="sarcos")
    network = canopen.Network(bus=bus)
    network.connect()
    yield network
    network.disconnect()


def test_remote_node_reads_and_writes_objects(network: canopen.Network) -> None:
    node = network.add_node(3, bundled_path())
    node.sdo.RESPONSE_TIMEOUT = 5.0
    assert node.sdo["Manufacturer device name"].raw == "armlink joint"
    assert node.sdo["Motor rated torque"].raw == 60_000
    node.sdo["Producer heartbeat time"].raw = 50
    assert node.sdo[0x1017].raw == 50
    with pytest.raises(canopen.SdoAbortedError, match="0x06010002"):
        node.sdo[0x6041].raw = 0


def test_remote_node_reads_maps_and_receives_pdos(network: canopen.Network) -> None:
    node = network.add_node(3, bundled_path())
    node.sdo.RESPONSE_TIMEOUT = 5.0
    node.tpdo.read()
    assert [variable.name for variable in node.tpdo[1]] == ["Position actual value", "Torque sensor.Reading"]
    node.tpdo[4].clear()
    node.tpdo[4].add_variable("Statusword")
    node.tpdo[4].add_variable("Torque sensor", "Reading")
    node.tpdo[4].cob_id = 0x480 + 3
    node.tpdo[4].trans_type = 1
    node.tpdo[4].enabled = True
    node.tpdo[4].save()
    received = threading.Event()
    node.tpdo[4].add_callback(lambda _: received.set())
    node.nmt.state = "OPERATIONAL"
    network.sync.transmit()
    assert received.wait(10.0)
    assert node.tpdo[4]["Statusword"].raw & 0x4F == 0x40


def test_a_bus_of_a_bundled_arm_opens_by_name_and_its_clock_is_simulated() -> None:
    with can.Bus(interface="armlink_sim", channel="parallel6") as bus:
        assert isinstance(bus, LockStepBus)
        assert bus.recv(0).arbitration_id == 0x70B
        while bus.recv(0) is not None:
            pass
        assert bus.recv(0.5) is None
        assert bus.clock.now() == pytest.approx(0.5)
        bus.clock.sleep_until(2.0)
        assert bus.clock.now() == pytest.approx(2.0)
        bus.clock.sleep_until(1.0)
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        assert bus.clock.now() == pytest.approx(2.004)
        np.testing.assert_allclose(bus.arm.plant.velocity, 0.0, atol=1e-3)


class TimeBySync(LockStepBus):
    """Simulated time passes with SYNC alone: the client's thread waits in the machine's own time."""

    def recv(self, timeout: float | None = None) -> can.Message | None:
        message = super().recv(0.0)
        if message is None and timeout != 0.0:
            time.sleep(1e-3)
        return message


def test_the_stock_client_drives_cyclic_velocity_where_nothing_else_is_offered() -> None:
    path = bundled_arms()["six-cia402"]
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["sim"]["device"] = "velocity"
    arm = parse_arm(content, path)
    simulated = SimulatedArm(arm, Truth.of(arm))
    network = canopen.Network(bus=TimeBySync(arm=simulated))
    network.connect()
    try:
        node = network.add_node(simulated.nodes[5].node_id, bundled_path())
        node.sdo.RESPONSE_TIMEOUT = 10.0
        assert node.sdo[0x6502].raw == 1 << 8
        node.sdo[0x6060].raw = 9
        for control in (0x06, 0x07, 0x0F):
            node.sdo[0x6040].raw = control
        assert (node.sdo[0x6041].raw & 0x6F, node.sdo[0x6061].raw) == (0x27, 9)
        node.nmt.state = "OPERATIONAL"

        def moved_in(cycles: int) -> float:
            before, since = node.sdo[0x6064].raw, simulated.time
            for _ in range(cycles):
                network.sync.transmit()
            assert simulated.time - since == pytest.approx(cycles / arm.require_link().rate)
            return node.sdo[0x6064].raw - before

        velocity = 40_000
        node.sdo[0x60FF].raw = velocity
        moved_in(50)
        assert moved_in(50) == pytest.approx(velocity * 50 / arm.require_link().rate, rel=0.05)
        node.sdo[0x60FF].raw = 0
        moved_in(50)
        assert abs(moved_in(25)) < 200
        node.sdo[0x6040].raw = 0
        assert node.sdo[0x6041].raw & 0x6F != 0x27
    finally:
        network.disconnect()
