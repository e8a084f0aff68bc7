"""The stock client of CubeMars AK motors (PyPI TMotorCANControl) operates a simulated one."""

import math
import warnings

import can
import pytest
from serving import GRAVITY_TORQUE, wait_for
from TMotorCANControl.mit_can import CAN_Manager, TMotorManager_mit_can

DRIVE = {"family": "cubemars", "id": 0x02, "model": "AK80-9", "can_timeout": 40_000, "kp": 40, "kd": 1.0}
AMPERE = 0.091 * 9 / 0.59
"""Torque of the frame that the client sends for one ampere [N·m]."""


class Manager(CAN_Manager):
    """Its one bus, on our channel: by itself it would configure can0 with sudo, and again at its end."""

    def __del__(self):
        pass


@pytest.fixture
def manager(arm, monkeypatch):
    manager = object.__new__(Manager)
    manager.bus = arm.client()
    manager.notifier = can.Notifier(manager.bus, [], timeout=0.05)
    monkeypatch.setattr(CAN_Manager, "_instance", manager)
    yield manager
    manager.notifier.stop()
    manager.bus.shutdown()


def repeat(motor, condition):
    """Update as a host does until the condition holds."""

    def step():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a busy machine: no data for 0.1 s
            motor.update()
        return condition()

    return wait_for(step)


def test_enable_hold_torque_feedback_silence_and_zero(arm, manager):
    with TMotorManager_mit_can("AK80-9", 0x02) as motor:
        assert arm.drive.motor_mode
        # it holds a position, and sags by gravity over its stiffness
        motor.set_impedance_gains_real_unit(K=100.0, B=3.0)
        motor.set_output_angle_radians(0.5)

        def rests():
            held = motor.position
            weight = GRAVITY_TORQUE * math.sin(held)
            told = motor.current_qaxis * AMPERE
            return abs(motor.velocity) < 0.02 and abs(told - weight) < 0.05 and abs(0.5 - held - weight / 100) < 2e-3

        assert repeat(motor, rests)
        assert motor.temperature == 33
        # torque, damped so that it comes to rest where gravity balances it
        motor.set_impedance_gains_real_unit_full_state_feedback(K=0.0, B=2.0)
        motor.set_motor_current_qaxis_amps(1.0 / AMPERE)
        assert repeat(motor, lambda: abs(arm.angle - math.asin(1.0 / GRAVITY_TORQUE)) < 0.03)
        # silence: its command becomes one of no torque, motor mode goes on, and the next command acts at once
        assert wait_for(lambda: not arm.drive.motor.powered)
        assert arm.drive.motor_mode
        assert repeat(motor, lambda: arm.drive.motor.powered)
        # zeroing shuts its communication for a second; it goes on with what it was told
        assert repeat(motor, lambda: abs(motor.velocity) < 0.02 and abs(motor.position - arm.angle) < 0.01)
        arm.do(lambda: setattr(arm.drive, "can_timeout", 0))
        before = arm.angle
        motor.set_zero_position()
        assert repeat(motor, lambda: abs(motor.position - (arm.angle - before)) < 0.02)
    assert wait_for(lambda: not arm.drive.motor.powered)
    assert arm.drive.flash_writes == 0


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_fault_is_told_and_cleared(arm, manager):
    with TMotorManager_mit_can("AK80-9", 0x02) as motor:
        arm.inject("feedback.lost")
        motor.power_on()
        assert wait_for(lambda: manager.notifier.exception is not None)
        assert "Encoder fault" in str(manager.notifier.exception)
        assert not arm.drive.motor.powered
    arm.do(lambda: (arm.drive.end_faults(), arm.drive.reboot()))
    manager.notifier.stop()
    while manager.bus.recv(0.1) is not None:  # replies from before
        pass
    manager.notifier = can.Notifier(manager.bus, [], timeout=0.05)
    with TMotorManager_mit_can("AK80-9", 0x02) as motor:
        motor.set_impedance_gains_real_unit(K=50.0, B=2.0)
        motor.set_output_angle_radians(0.2)
        assert repeat(motor, lambda: abs(arm.angle - 0.2) < 0.03)
    assert manager.notifier.exception is None
