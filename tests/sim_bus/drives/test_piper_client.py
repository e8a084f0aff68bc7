"""The stock client piper_sdk (PyPI) operates a simulated joint of a Piper arm."""

import math
import time

import pytest
from serving import GRAVITY_TORQUE, wait_for

piper_sdk = pytest.importorskip("piper_sdk")

DRIVE = {"family": "piper", "joint": 2, "firmware": "S-V1.6-3"}


@pytest.fixture
def client(arm, monkeypatch):
    """Its bus is opened here: by itself it would take SocketCAN alone."""
    from piper_sdk.hardware_port import can_encapsulation

    monkeypatch.setattr(can_encapsulation.can.interface, "Bus", lambda **keys: arm.client())
    sdk = piper_sdk.C_PiperInterface_V2("virtual", judge_flag=False, can_auto_init=False)
    sdk.CreateCanBus("virtual", bustype="virtual")
    monkeypatch.undo()
    sdk.ConnectPort()
    yield sdk
    sdk.DisconnectPort()


def test_firmware_enable_mit_targets_states_and_stop(arm, client):
    def motor():
        return client.GetArmHighSpdInfoMsgs().motor_2

    def repeat(step, condition):
        return wait_for(lambda: (step(), condition())[1])

    assert wait_for(lambda: client.GetPiperFirmwareVersion() == "S-V1.6-3")
    client.EnableArm(2)
    assert wait_for(lambda: arm.drive.enabled and client.GetArmLowSpdInfoMsgs().motor_2.foc_status.driver_enable_status)

    # its MIT law: gains are as they are said, the torque is four times as much
    def push():
        client.MotionCtrl_2(1, 4, 100, 0xAD)
        client.JointMitCtrl(2, 0.0, 0.0, 0.0, 1.0, 0.25)

    step = 16 / 255  # of a torque, to whose lower end the SDK rounds
    balanced = math.asin(4 * (math.floor(8.25 / step) * step - 8) / GRAVITY_TORQUE)
    assert repeat(push, lambda: abs(arm.angle - balanced) < 0.02 and abs(motor().motor_speed) < 20)
    degrees = client.GetArmJointMsgs().joint_state.joint_2 * 0.001
    assert math.radians(degrees) == pytest.approx(arm.angle, abs=0.02)
    # what the SDK converts is four times the torque that carries the pendulum
    assert motor().cal_effort() * 0.001 == pytest.approx(4 * GRAVITY_TORQUE * math.sin(arm.angle), abs=0.4)

    # targets, with a speed
    def lead():
        client.MotionCtrl_2(1, 1, 50, 0)
        client.JointCtrl(0, round(math.degrees(0.8) * 1000), 0, 0, 0, 0)

    assert repeat(lead, lambda: abs(arm.angle - 0.8) < 0.01)
    time.sleep(0.5)
    assert arm.drive.motor.powered  # no time-out: it goes on
    client.EmergencyStop(1)
    assert wait_for(lambda: client.GetArmStatus().arm_status.arm_status == 1)
    client.EmergencyStop(2)
    assert wait_for(lambda: not arm.drive.motor.powered)
