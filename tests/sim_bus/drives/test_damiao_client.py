"""The stock client of Damiao motors (PyPI damiao-motor) operates a simulated one."""

import math
import warnings

import pytest
from damiao_motor import DaMiaoController
from serving import GRAVITY_TORQUE, wait_for

DRIVE = {"family": "damiao", "id": 0x02, "reply": 0x12, "model": "DM4340", "kp": 40, "kd": 1.0}


@pytest.fixture
def motor(arm):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # it opens its bus by python-can's old keyword
        controller = DaMiaoController(channel=arm.channel, bustype="virtual")
    motor = controller.add_motor(0x02, 0x12, "4340")
    yield motor
    controller.shutdown()


def repeat(motor, condition, **command):
    """Send a command as a host does until the condition holds."""

    def step():
        motor.send_cmd_mit(**command)
        return condition()

    return wait_for(step)


def status(motor):
    return motor.get_states().get("status")


def test_enable_hold_torque_feedback_fault_and_silence(arm, motor):
    motor.ensure_control_mode("MIT")
    assert [motor.get_register(rid) for rid in (21, 22, 23)] == [12.5, 10.0, 28.0]
    motor.set_can_timeout(2000)
    motor.enable()
    assert wait_for(lambda: status(motor) == "ENABLED")
    # it holds a position, and sags by gravity over its stiffness
    held = 0.5
    weight = GRAVITY_TORQUE * math.sin(held)

    def rests():
        state = motor.get_states()
        sag = held - state["pos"]
        return abs(state["vel"]) < 0.02 and abs(state["torq"] - weight) < 0.05 and abs(sag - weight / 200.0) < 1e-3

    assert repeat(motor, rests, target_position=held, stiffness=200.0, damping=4.0)
    # torque, damped so that it comes to rest where gravity balances it
    torque = 1.0
    angle = math.asin(torque / GRAVITY_TORQUE)
    assert repeat(motor, lambda: abs(arm.angle - angle) < 0.02, feedforward_torque=torque, damping=2.0)
    # a fault and its clearing: the client clears it by itself in its next command, and enables again
    arm.inject("drive.trip")
    assert repeat(motor, lambda: status(motor) == "LOST_COMM" or status(motor) == "DISABLED")
    assert repeat(motor, lambda: status(motor) == "ENABLED")
    # silence: its TIMEOUT register
    motor.set_can_timeout(50)
    assert repeat(motor, lambda: arm.drive.registers[9] == 1000)
    assert wait_for(lambda: not arm.drive.motor.powered)
    motor.request_motor_feedback()
    assert wait_for(lambda: status(motor) == "LOST_COMM")
    assert arm.drive.flash_writes == 0


def test_a_latched_watchdog_and_a_wrong_mode(arm, motor):
    arm.inject("drive.mode", 2)
    motor.enable()
    assert wait_for(lambda: status(motor) == "ENABLED")
    assert repeat(motor, lambda: motor.get_states()["pos"] != 0, target_position=1.0, stiffness=200.0, damping=4.0)
    assert abs(arm.angle) < 0.05  # its MIT commands are not understood
    motor.set_control_mode(1)  # its ensure_control_mode would verify by what it read before
    motor.registers.clear()
    assert motor.get_register(10) == 1
    assert repeat(motor, lambda: abs(arm.angle - 1.0) < 0.05, target_position=1.0, stiffness=200.0, damping=4.0)
    arm.inject("drive.latched")
    for _ in range(20):
        motor.clear_error()
        motor.enable()
    motor.request_motor_feedback()
    assert wait_for(lambda: status(motor) == "LOST_COMM")
