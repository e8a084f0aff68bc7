"""The stock client of RobStride motors (PyPI robstride 0.1.0) and frames of the manual operate a simulated one.

The client knows two models and no motion commands; those are written out here from the manual's chapter 4.
"""

import math
import struct

import can
import pytest
from robstride.client import Client, MotorMode, RunMode
from serving import GRAVITY_TORQUE, wait_for

DRIVE = {"family": "robstride", "id": 0x7F, "model": "RS01", "kp": 40, "kd": 1.0}
MOTOR, HOST = 0x7F, 0xAA
P, V, T = 12.57, 44.0, 17.0


@pytest.fixture
def bus(arm):
    bus = arm.client()
    yield bus
    bus.shutdown()


def u16(value, lowest, highest):
    return round((value - lowest) / (highest - lowest) * 65535)


def motion(position=0.0, kp=0.0, kd=0.0, torque=0.0):
    """Type 1: torque in bits 8 to 23 of the identifier; position, velocity, kp, kd big endian."""
    data = struct.pack(">4H", u16(position, -P, P), u16(0.0, -V, V), u16(kp, 0, 500), u16(kd, 0, 5))
    return can.Message(arbitration_id=1 << 24 | u16(torque, -T, T) << 8 | MOTOR, data=data, is_extended_id=True)


def drive_until(bus, client, condition, **command):
    def step():
        bus.send(motion(**command))
        step.feedback = client._parse_feedback_resp(client._recv(), MOTOR, 1)
        return condition(step.feedback)

    assert wait_for(step)
    return step.feedback


def test_enable_hold_torque_feedback_fault_and_silence(arm, bus):
    client = Client(bus, host_can_id=HOST)
    assert client.read_param(MOTOR, "run_mode") == RunMode.Operation
    assert client.read_param(MOTOR, "limit_torque") == pytest.approx(17.0)
    bus.send(can.Message(arbitration_id=18 << 24 | HOST << 8 | MOTOR, data=bytes.fromhex("2870000020a10700")))
    assert client._recv() is not None  # canTimeout 500000 = 25 s
    feedback = client.enable(MOTOR)
    assert arm.drive.mode == 2
    assert feedback.errors == []
    # it holds a position, and sags by gravity over its stiffness
    held = 0.5
    weight = GRAVITY_TORQUE * math.sin(held)

    def rests(f):
        return abs(f.angle - held) < 0.02 and abs(f.velocity) < 0.01 and abs(f.torque - weight) < 0.2

    feedback = drive_until(bus, client, rests, position=held, kp=200.0, kd=4.0)
    assert feedback.temp == 33.0
    # torque
    angle = math.asin(1.0 / GRAVITY_TORQUE)
    drive_until(bus, client, lambda f: abs(f.angle - angle) < 0.02, torque=1.0, kd=2.0)
    # a fault and its clearing: type 4 with byte 0 = 1
    arm.inject("feedback.lost")
    feedback = drive_until(bus, client, lambda f: bool(f.errors))
    assert [error.name for error in feedback.errors] == ["MagneticEncodingFault"]
    arm.drive.faults.clear()
    bus.send(can.Message(arbitration_id=4 << 24 | HOST << 8 | MOTOR, data=bytes([1, *bytes(7)])))
    assert client._parse_feedback_resp(client._recv(), MOTOR, 1).errors == []
    client.enable(MOTOR)
    assert arm.drive.motor.powered
    # silence: canTimeout of 50 ms
    bus.send(can.Message(arbitration_id=18 << 24 | HOST << 8 | MOTOR, data=bytes.fromhex("28700000e8030000")))
    assert client._recv() is not None
    assert wait_for(lambda: not arm.drive.motor.powered)
    feedback = client.disable(MOTOR)
    assert feedback.mode == MotorMode.Reset
    assert arm.drive.flash_writes == 0


def test_an_unknown_parameter_answers_zeros_with_its_mark(arm, bus):
    bus.send(can.Message(arbitration_id=17 << 24 | HOST << 8 | MOTOR, data=bytes.fromhex("ff70000000000000")))
    answer = bus.recv(10.0)
    assert answer.arbitration_id == 0x11017FAA
    assert bytes(answer.data) == bytes.fromhex("ff70000000000000")
