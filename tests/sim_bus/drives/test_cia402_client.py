"""The stock client of CANopen (PyPI canopen) operates a stock CiA 402 drive: no object of ours, torque from current."""

import math
import time

import canopen
import pytest
from serving import GRAVITY_TORQUE, wait_for

from armlink.drives.canopen.eds_file import bundled_path

DRIVE = {"family": "canopen", "node": 5, "torque": "motor"}
UNIT = 2 * math.pi / 2**20
RATED, HOST = 10.0, 0x7E
STATE, ENABLED, QUICK_STOP, FAULT, SWITCH_ON_DISABLED = 0x6F, 0x27, 0x07, 0x08, 0x40


@pytest.fixture
def node(arm):
    network = canopen.Network()
    network.connect(interface="virtual", channel=arm.channel)
    node = network.add_node(5, bundled_path())
    node.sdo.RESPONSE_TIMEOUT = 10.0
    yield node
    network.sync.stop()
    network.disconnect()


def state(node):
    return node.sdo[0x6041].raw & STATE


def enable(node):
    for word in (0x06, 0x07, 0x0F):
        node.sdo[0x6040].raw = word
    assert wait_for(lambda: state(node) == ENABLED)


def torque_of(node):
    """Torque actual value [N·m]."""
    return node.sdo[0x6077].raw * RATED / 1000


def test_enable_hold_torque_feedback_fault_and_silence(arm, node):
    with pytest.raises(canopen.SdoAbortedError):
        _ = node.sdo[0x2100][1].raw  # not a device of ours
    assert node.sdo[0x6076].raw == RATED * 1000
    node.nmt.state = "OPERATIONAL"
    # it holds a position, by its own servo
    node.sdo[0x6060].raw = 8
    node.sdo[0x607A].raw = node.sdo[0x6064].raw
    enable(node)
    assert node.sdo[0x6061].raw == 8
    start, held = node.sdo[0x6064].raw, round(0.5 / UNIT)
    for step in range(1, 51):
        node.sdo[0x607A].raw = start + (held - start) * step // 50
        node.network.sync.transmit()
        time.sleep(0.01)

    def rests():
        node.network.sync.transmit()
        weight = GRAVITY_TORQUE * math.sin(arm.angle)
        return abs(node.sdo[0x6064].raw * UNIT - 0.5) < 2e-3 and abs(torque_of(node) - weight) < 0.05

    assert wait_for(rests)
    assert arm.angle == pytest.approx(0.5, abs=0.01)
    # torque: first what gravity asks for, then another, which it tells
    node.sdo[0x6071].raw = round(GRAVITY_TORQUE * math.sin(0.5) / RATED * 1000)
    node.sdo[0x6060].raw = 10
    node.network.sync.transmit()
    assert wait_for(lambda: node.sdo[0x6061].raw == 10)
    node.sdo[0x6071].raw = 30
    assert wait_for(lambda: (node.network.sync.transmit(), abs(torque_of(node) - 0.3) < 0.02)[1])
    # a fault and its clearing, told by an emergency too
    arm.do(lambda: arm.arm.drives.fault(0, 0x7305))
    assert wait_for(lambda: 0x7305 in [each.code for each in node.emcy.log])
    assert wait_for(lambda: node.sdo[0x6041].raw & 0x4F == FAULT)
    node.sdo[0x6040].raw = 0x00
    node.sdo[0x6040].raw = 0x80
    assert wait_for(lambda: node.sdo[0x6041].raw & 0x4F == SWITCH_ON_DISABLED)
    # silence: the host's heartbeat ends, and the drive holds in quick stop
    node.sdo[0x6060].raw = 8
    node.sdo[0x607A].raw = node.sdo[0x6064].raw
    node.sdo[0x605A].raw, node.sdo[0x6007].raw = 6, 3
    enable(node)
    node.sdo[0x1016][1].raw = HOST << 16 | 200
    node.network.send_message(0x700 + HOST, b"\x05")
    assert wait_for(lambda: state(node) == QUICK_STOP)
