"""ODrive's published message file (cantools) and the stock client odrive-can operate a simulated axis."""

import asyncio
import math
import struct

import can
import pytest
from odrive_can import get_dbc
from odrive_can.odrive import DriveError, ODriveCAN
from serving import GRAVITY_TORQUE, served, wait_for

DRIVE = {"family": "odrive", "node": 1}
TURN = 2 * math.pi


def as_float(bits):
    """The message file has no floats: it gives their bits as integers."""
    return bits if isinstance(bits, float) else struct.unpack("<f", struct.pack("<I", bits))[0]


class Client:
    """A host of nothing but python-can, cantools and the message file."""

    def __init__(self, bus):
        self.bus, self.file, self.latest = bus, get_dbc(), {}

    def send(self, name, **values):
        message = self.file.get_message_by_name(f"Axis1_{name}")
        data = message.encode(values) if message.length else b""
        self.bus.send(can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=False))

    def listen(self):
        while (message := self.bus.recv(0.0)) is not None:
            known = self.file.get_message_by_frame_id(message.arbitration_id)
            self.latest[known.name.split("_", 1)[1]] = known.decode(message.data)

    def until(self, condition, step=lambda: None):
        def done():
            step()
            self.listen()
            try:
                return condition(self)
            except KeyError:
                return False

        return wait_for(done)

    def value(self, message, signal):
        return as_float(self.latest[message][signal])


@pytest.fixture
def arm():
    with served(DRIVE, fd=False, rate=50) as arm:  # a slow client is not to read old frames
        yield arm


@pytest.fixture
def client(arm):
    bus = arm.client()
    yield Client(bus)
    bus.shutdown()


def test_the_published_message_file_operates_an_axis(arm, client):
    assert client.until(lambda c: c.latest["Heartbeat"]["Axis_State"] == "IDLE")
    client.send("Set_Controller_Mode", Control_Mode="POSITION_CONTROL", Input_Mode="PASSTHROUGH")
    held = 0.5 / TURN

    def hold():
        client.send("Set_Input_Pos", Input_Pos=held, Vel_FF=0, Torque_FF=0)

    hold()
    client.send("Set_Axis_State", Axis_Requested_State="CLOSED_LOOP_CONTROL")
    assert client.until(lambda c: c.latest["Heartbeat"]["Axis_State"] == "CLOSED_LOOP_CONTROL", hold)
    assert client.until(
        lambda c: (
            abs(c.value("Get_Encoder_Estimates", "Pos_Estimate") - held) < 1e-3
            and abs(c.value("Get_Encoder_Estimates", "Vel_Estimate")) < 1e-3
            and abs(c.value("Get_Torques", "Torque_Estimate") - GRAVITY_TORQUE * math.sin(arm.angle)) < 0.1
        ),
        hold,
    )
    assert arm.angle == pytest.approx(0.5, abs=0.01)
    # torque
    client.send("Set_Controller_Mode", Control_Mode="TORQUE_CONTROL", Input_Mode="PASSTHROUGH")
    assert client.until(
        lambda c: abs(c.value("Get_Torques", "Torque_Estimate") - 0.3) < 0.02,
        lambda: client.send("Set_Input_Torque", Input_Torque=0.3),
    )
    # silence: its watchdog, and the clearing of the fault
    assert client.until(lambda c: c.latest["Heartbeat"]["Axis_State"] == "IDLE")
    assert client.latest["Heartbeat"]["Axis_Error"] == "WATCHDOG_TIMER_EXPIRED"
    assert not arm.drive.motor.powered
    client.send("Clear_Errors", Identify=0)
    assert client.until(lambda c: c.latest["Heartbeat"]["Axis_Error"] == "NONE")
    # a remote frame is answered
    can_id = client.file.get_message_by_name("Axis1_Get_Version").frame_id
    client.bus.send(can.Message(arbitration_id=can_id, is_extended_id=False, is_remote_frame=True, dlc=8))
    assert client.until(lambda c: c.latest["Get_Version"]["Fw_Version_Minor"] == 6)


PATIENCE = 6000
"""Looks, 10 ms apart, at a drive that a busy machine keeps waiting."""


async def operate(arm, bus):
    drive = ODriveCAN(axis_id=1, can_bus=bus)
    await asyncio.wait_for(drive.start(), 20.0)
    try:
        drive.check_alive()
        drive.set_controller_mode("POSITION_CONTROL", "PASSTHROUGH")
        drive.set_input_pos(0.1)
        drive.set_axis_state_no_wait("CLOSED_LOOP_CONTROL")
        for _ in range(PATIENCE):
            drive.set_input_pos(0.1)
            await asyncio.sleep(0.01)
            if drive.axis_state == "CLOSED_LOOP_CONTROL" and abs(arm.angle - 0.1 * TURN) < 0.02:
                break
        assert arm.angle == pytest.approx(0.1 * TURN, abs=0.02)
        estimate = await drive.get_encoder_estimates()
        assert as_float(estimate["Pos_Estimate"]) == pytest.approx(0.1, abs=0.01)
        arm.inject("feedback.lost")
        said = ""
        for _ in range(PATIENCE):
            drive.set_input_pos(0.1)  # or its watchdog ends it
            await asyncio.sleep(0.01)
            try:
                drive.check_errors()
            except DriveError as error:
                said = str(error)
                break
        assert "MISSING_ESTIMATE" in said
        arm.drive.faults.clear()
        drive.clear_errors()
        await asyncio.sleep(0.3)
        drive.check_errors()
    finally:
        drive.stop()


def test_the_stock_client_operates_an_axis(arm):
    asyncio.run(operate(arm, arm.client()))
