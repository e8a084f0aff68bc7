"""A client of nothing but python-can and canopen, its BaseNode402 included, operates `armlink sim` on SocketCAN.

Then can-utils do: candump sees, cansend commands.
"""

import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import can
import canopen
import pytest
from canopen.profiles.p402 import BaseNode402
from rig import wait_for

pytestmark = pytest.mark.vcan

ROOT = Path(__file__).parents[3]
EDS = str(ROOT / "armlink" / "drives" / "canopen" / "eds" / "joint.eds")
BUS = "socketcan:vcan0"
NODE = 5
ARM = """
name: pendulum
kinematics:
  gravity: [0.0, -9.81, 0.0]
  joints:
    - {name: hinge, lower: -1.0, upper: 1.0}
link:
  bus: {interface: socketcan, channel: vcan0}
  joints:
    - {name: hinge, node: 5, rated_torque: 10.0, max_torque: 20.0, max_velocity: 2.0}
sim:
  links: [{mass: 1.0, com: [0.2, 0.0, 0.0], inertia: [0.01, 0.01, 0.01]}]
  sensors: {noise: [0.0], bits: 20}
"""


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    if not Path("/sys/class/net/vcan0").exists():  # before the mark's own skip, since this fixture is the module's
        pytest.skip("needs a SocketCAN interface vcan0: run it with scripts/with-vcan .venv/bin/pytest -m vcan")
    path = tmp_path_factory.mktemp("arm") / "pendulum.yaml"
    path.write_text(ARM)
    command = [sys.executable, "-c", "from armlink.cli import main; main()", "sim", str(path), "--bus", BUS]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert "nodes 5" in process.stderr.readline()
        yield
        process.terminate()
        process.communicate(timeout=30)


@pytest.fixture
def node(simulated: None) -> Iterator[BaseNode402]:
    network = canopen.Network()
    network.connect(interface="socketcan", channel="vcan0")
    node = BaseNode402(NODE, EDS)
    network.add_node(node)
    node.sdo.RESPONSE_TIMEOUT = 3.0  # a user-mode kernel has one slow core
    node.TIMEOUT_SWITCH_STATE_FINAL = node.TIMEOUT_SWITCH_STATE_SINGLE = node.TIMEOUT_SWITCH_OP_MODE = 20.0
    node.TIMEOUT_CHECK_TPDO = 5.0
    yield node
    network.sync.stop()
    network.disconnect()


def map_for_canopen(node: BaseNode402) -> None:
    """The stock profile wants control word and mode in RPDOs, status word and mode display in TPDOs."""
    node.rpdo.read()
    node.tpdo.read()
    node.rpdo[1].clear()
    for name in ("Controlword", "Target torque", "Target position"):
        node.rpdo[1].add_variable(name)
    node.rpdo[1].trans_type, node.rpdo[1].enabled = 255, True
    node.tpdo[3].clear()
    for name in ("Statusword", "Modes of operation display"):
        node.tpdo[3].add_variable(name)
    node.tpdo[3].trans_type, node.tpdo[3].enabled = 1, True  # the stock profile takes what came twice for periodic
    node.tpdo[1].trans_type, node.tpdo[1].enabled = 1, True
    node.rpdo[1].save()
    node.tpdo[3].save()
    node.tpdo[1].save()


def test_nmt_sdo_heartbeat_pdo_and_cia_402(node: BaseNode402) -> None:
    # NMT and boot-up; canopen's own wait_for_bootup misses one that comes before it begins to wait
    boot_ups: list[bytes] = []
    node.network.subscribe(0x700 + NODE, lambda _id, data, _time: boot_ups.append(bytes(data)))
    node.nmt.state = "RESET"
    assert wait_for(lambda: b"\0" in boot_ups)
    # SDO
    assert node.sdo["Manufacturer device name"].raw == "armlink joint"
    node.sdo["Quick stop option code"].raw = 6
    # heartbeat
    node.sdo["Producer heartbeat time"].raw = 100
    node.nmt.wait_for_heartbeat(10.0)
    assert node.nmt.state == "PRE-OPERATIONAL"
    # PDO and CiA 402
    map_for_canopen(node)
    node.setup_402_state_machine(read_pdos=False)
    node.nmt.state = "OPERATIONAL"
    assert wait_for(lambda: node.nmt.wait_for_heartbeat(10.0) == "OPERATIONAL")
    node.network.sync.start(0.1)  # TPDO1 and 2 are synchronous
    node.op_mode = "PROFILED POSITION"
    for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
        node.state = state
    assert wait_for(lambda: node.state == "OPERATION ENABLED")
    assert node.op_mode == "PROFILED POSITION"
    start = node.sdo["Position actual value"].raw
    node.rpdo[1]["Target position"].raw = start + 40_000
    node.rpdo[1].transmit()
    assert wait_for(lambda: abs(node.sdo["Position actual value"].raw - start - 40_000) < 500)
    assert node.tpdo[1].wait_for_reception(10.0) is not None
    assert node.tpdo[1]["Position actual value"].raw == pytest.approx(start + 40_000, abs=500)
    node.state = "QUICK STOP ACTIVE"
    assert wait_for(lambda: node.state == "QUICK STOP ACTIVE")
    node.state = "SWITCH ON DISABLED"
    assert wait_for(lambda: node.state == "SWITCH ON DISABLED")


def test_a_host_whose_heartbeat_ends_is_noticed_by_the_node(node: BaseNode402) -> None:
    node.nmt.state = "PRE-OPERATIONAL"
    node.sdo["Consumer heartbeat time"][1].raw = 0x7E << 16 | 300
    node.network.send_message(0x700 + 0x7E, b"\x05")
    emergency = node.emcy.wait(0x8130, timeout=10.0)
    assert emergency is not None
    assert emergency.code == 0x8130
    node.sdo["Consumer heartbeat time"][1].raw = 0


def test_candump_and_cansend(simulated: None) -> None:
    tools = [shutil.which(name) for name in ("candump", "cansend")]
    if None in tools:
        pytest.skip("no can-utils: scripts/install-system installs them where that is allowed")
    candump, cansend = tools
    listening = subprocess.Popen(
        [candump, "-n", "2", "-T", "60000", "vcan0,585:7FF,605:7FF"], stdout=subprocess.PIPE, text=True
    )
    time.sleep(2.0)
    subprocess.run([cansend, "vcan0", "605#4000100000000000"], check=True)
    seen, _ = listening.communicate(timeout=90)
    assert "605   [8]  40 00 10 00 00 00 00 00" in seen
    assert "585   [8]  43 00 10 00 92 01 02 00" in seen


def test_a_client_of_python_can_alone_reads_a_position(simulated: None) -> None:
    with can.Bus(channel="vcan0", interface="socketcan", can_filters=[{"can_id": 0x585, "can_mask": 0x7FF}]) as bus:
        bus.send(can.Message(arbitration_id=0x605, data=bytes.fromhex("4064600000000000"), is_extended_id=False))
        answer = bus.recv(10.0)
    assert answer is not None
    assert answer.data[:4] == bytes.fromhex("43646000")
    assert abs(struct.unpack("<i", answer.data[4:])[0]) < 1 << 20
