"""The stock client motorbridge (PyPI) operates a simulated MyActuator drive; it opens SocketCAN alone."""

import math
import threading
import time
from collections.abc import Iterator

import can
import pytest
from serving import GRAVITY_TORQUE, pendulum, wait_for

from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

DRIVE = {"family": "myactuator", "id": 1, "model": "X8-25", "timeout_ms": 500}
STEP, QUIET = 0.01, 0.3
"""Time of the arm for each frame, however slow this machine is, and after QUIET seconds without a frame [s]."""


@pytest.fixture
def arm() -> Iterator[SimulatedArm]:
    """Its time passes by the client's frames: a user-mode kernel simulates more slowly than the clock runs."""
    described = pendulum(DRIVE, rate=100)
    simulated, ends = SimulatedArm(described, Truth.of(described)), threading.Event()

    def serve() -> None:
        with can.Bus(interface="socketcan", channel="vcan0") as bus:
            while not ends.is_set():
                message = bus.recv(QUIET)
                if message is not None:
                    simulated.on_frame(message.arbitration_id, bytes(message.data))
                simulated.advance(STEP if message is not None else QUIET)
                while simulated.outbox:
                    can_id, data = simulated.outbox.popleft()
                    bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield simulated
    ends.set()
    thread.join(10.0)


@pytest.mark.vcan
def test_position_speed_states_silence_and_shutdown(arm: SimulatedArm) -> None:
    from motorbridge import Controller, Mode

    drive = arm.device(0)

    def angle() -> float:
        return float(arm.plant.position[0])

    with Controller("vcan0") as controller:
        motor = controller.add_myactuator_motor(1, 0x241, "X8")

        def repeat(command, condition):
            def step():
                command()
                motor.request_feedback()
                time.sleep(0.1)
                controller.poll_feedback_once()
                told = motor.get_state()
                return told is not None and condition(told)

            return wait_for(step, 60.0)

        controller.enable_all()
        motor.ensure_mode(Mode.POS_VEL, 1000)

        def holds(told):
            """It calls the drive's current its torque, and takes whole degrees for hundredths."""
            weight = GRAVITY_TORQUE * math.sin(angle())
            there = abs(100 * told.pos - 0.5) < 0.01 and abs(angle() - 0.5) < 0.005
            return there and abs(told.torq * drive.constant - weight) < 0.1

        assert repeat(lambda: motor.send_pos_vel(0.5, 2.0), holds)
        motor.ensure_mode(Mode.VEL, 1000)
        assert repeat(lambda: motor.send_vel(-0.5), lambda told: angle() < 0.0 and abs(told.vel + 0.5) < 0.1)
        # silence: its time-out lets it go, and the next command acts at once
        assert wait_for(lambda: not drive.motor.powered)
        assert repeat(lambda: motor.send_vel(0.0), lambda told: drive.motor.powered)
        controller.disable_all()
        assert wait_for(lambda: not drive.motor.powered)
        assert drive.flash_writes == 0
