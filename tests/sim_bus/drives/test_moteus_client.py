"""mjbots' own client (PyPI moteus) operates a simulated controller through its python-can transport, on CAN FD."""

import asyncio
import math

import can
import moteus
import pytest
from moteus import Register
from serving import GRAVITY_TORQUE, served, wait_for

DRIVE = {"family": "moteus", "id": 1}
TURN = 2 * math.pi


async def poll(step, condition, seconds=20.0):
    """Call `step` as a host does until its result fulfils the condition."""
    end = asyncio.get_running_loop().time() + seconds
    while True:
        result = await step()
        if condition(result.values):
            return result.values
        assert asyncio.get_running_loop().time() < end
        await asyncio.sleep(0.005)


async def operate(arm):
    transport = moteus.PythonCan(interface="virtual", channel=arm.channel, protocol=can.CanProtocol.CAN_FD)
    controller = moteus.Controller(id=1, transport=transport)
    try:
        state = (await controller.query()).values
        assert (state[Register.MODE], state[Register.FAULT], state[Register.VOLTAGE]) == (0, 0, 48.0)
        # it holds a position
        held = 0.5 / TURN
        state = await poll(
            lambda: controller.set_position(position=held, velocity=0.0, watchdog_timeout=20.0, query=True),
            lambda values: (
                abs(values[Register.POSITION] - held) < 1e-3
                and abs(values[Register.VELOCITY]) < 1e-3
                and abs(values[Register.TORQUE] - GRAVITY_TORQUE * math.sin(held * TURN)) < 0.1
            ),
        )
        assert state[Register.MODE] == 10
        assert arm.angle == pytest.approx(0.5, abs=0.01)
        # its torque is limited by the command
        await poll(
            lambda: controller.set_position(
                position=0.25, velocity=0.0, maximum_torque=0.5, watchdog_timeout=20.0, query=True
            ),
            lambda values: 0.45 <= abs(values[Register.TORQUE]) <= 0.505,
        )
        # torque
        await poll(
            lambda: controller.set_position(
                position=math.nan, kp_scale=0.0, kd_scale=0.0, ilimit_scale=0.0, feedforward_torque=0.3,
                watchdog_timeout=20.0, query=True,
            ),
            lambda values: abs(values[Register.TORQUE] - 0.3) < 0.02,
        )  # fmt: skip
        # a fault and its clearing
        arm.inject("feedback.lost")
        state = await poll(controller.query, lambda values: values[Register.MODE] == 1)
        assert state[Register.FAULT] == 35
        arm.drive.faults.clear()
        await controller.set_stop()
        await poll(controller.query, lambda values: values[Register.MODE] == 0 and values[Register.FAULT] == 0)
        # silence: it damps, latched until a stop
        await controller.set_position(position=math.nan, velocity=0.0, watchdog_timeout=0.05, query=True)
        state = await poll(controller.query, lambda values: values[Register.MODE] == 11)
        await controller.set_position(position=0.0, watchdog_timeout=20.0)
        assert (await controller.query()).values[Register.MODE] == 11
        await controller.set_stop()
        await poll(controller.query, lambda values: values[Register.MODE] == 0)
    finally:
        transport.close()


def test_enable_hold_torque_feedback_fault_and_silence():
    with served(DRIVE, fd=True) as arm:
        asyncio.run(operate(arm))
        assert wait_for(lambda: not arm.drive.motor.powered)


async def ask_in_other_resolutions(arm):
    transport = moteus.PythonCan(interface="virtual", channel=arm.channel, protocol=can.CanProtocol.CAN_FD)
    resolution = moteus.QueryResolution()
    resolution.position = moteus.INT16
    resolution.velocity = moteus.INT8
    resolution.torque = moteus.INT32
    resolution.temperature = moteus.INT8
    controller = moteus.Controller(id=9, transport=transport, query_resolution=resolution)
    try:
        return (await controller.query()).values
    finally:
        transport.close()


def test_integers_and_identifiers_of_29_bits():
    with served({"family": "moteus", "id": 9, "zero": 1.0}, fd=True) as arm:
        values = asyncio.run(ask_in_other_resolutions(arm))
    assert values[Register.POSITION] == pytest.approx(1.0 / TURN, abs=1e-4)
    assert values[Register.TEMPERATURE] == 31.0
