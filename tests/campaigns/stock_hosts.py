"""Hosts that are not ours: each family's stock client sways all joints of a bundled arm, on a bus of python-can.

`stock_hosts.py ARM six-damiao 239.74.163.77 --seconds 600`: damiao-motor, moteus, odrive-can, canopen,
TMotorCANControl, and robstride with the motion commands of the manual, which it lacks. Of armlink they use the arm
file's numbers (ids, direction, zero, gear) and nothing else.
"""

import argparse
import asyncio
import contextlib
import math
import struct
import time
import warnings
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import can

from armlink.arm_file import load_arm
from armlink.drives.canopen.eds_file import bundled_path
from sim_bus.sim_section import SimSection

RATE = 50.0
"""Of the commands [Hz]."""
SWAY, SECONDS = 0.3, 6.0
"""Way of each joint [rad] and time for it and back [s]."""
TURN = 2 * math.pi


class Way:
    """Where each drive of an arm is to be: drive-side angles and velocities, one raised cosine after the other."""

    def __init__(self, name: str) -> None:
        arm = load_arm(name)
        self.rows = arm.require_link().joints
        self.start: tuple[float, ...] = arm.require(SimSection, "sim").start or ()
        self.began = time.monotonic()

    def begin(self) -> None:
        self.began = time.monotonic()

    def at(self, joint: int) -> tuple[float, float]:
        """Angle [rad] and velocity [rad/s] of the drive's output now."""
        angle = TURN * (time.monotonic() - self.began) / SECONDS
        side, drive = -math.copysign(SWAY / 2, self.start[joint]), self.rows[joint].settings
        factor = drive.direction * drive.gear
        position = self.start[joint] + side * (1 - math.cos(angle))
        return factor * position + drive.zero, factor * side * math.sin(angle) * TURN / SECONDS


def ticks(seconds: float) -> Iterator[None]:
    """One a command period."""
    due = time.monotonic()
    end = due + seconds
    while due < end:
        yield
        due += 1 / RATE
        time.sleep(max(0.0, due - time.monotonic()))


def damiao(way: Way, channel: str, seconds: float) -> None:
    """damiao-motor."""
    from damiao_motor import DaMiaoController

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        controller = DaMiaoController(channel=channel, bustype="udp_multicast")
    kinds = [row.settings.model.removeprefix("DM") for row in way.rows]
    motors = [
        controller.add_motor(row.settings.id, row.settings.reply, kind)
        for row, kind in zip(way.rows, kinds, strict=True)
    ]
    for motor in motors:
        motor.ensure_control_mode("MIT")
        motor.set_can_timeout(5000)
        motor.enable()
    way.begin()
    for _ in ticks(seconds):
        for joint, motor in enumerate(motors):
            (q, dq), (kp, kd) = way.at(joint), gains(joint)
            with contextlib.suppress(RuntimeError):  # it clears an error by itself and tells so
                motor.send_cmd_mit(q, dq, kp, kd)
    controller.shutdown()


def gains(joint: int) -> tuple[float, float]:
    """kp [N·m/rad] and kd [N·m·s/rad] of MIT commands."""
    return (100.0, 4.0) if joint < 3 else (25.0, 1.0)


def cubemars(way: Way, channel: str, seconds: float) -> None:
    """TMotorCANControl, with one of its managers a motor; its bus is opened here, for it would configure can0."""
    from TMotorCANControl.mit_can import CAN_Manager, TMotorManager_mit_can

    class Manager(CAN_Manager):  # type: ignore[misc]
        def __del__(self) -> None: ...

    replies = [{"can_id": 0, "can_mask": 0x7FF, "extended": False}]  # udp_multicast gives back what one sends
    manager = CAN_Manager._instance = object.__new__(Manager)
    manager.bus = can.Bus(interface="udp_multicast", channel=channel, can_filters=replies)
    manager.notifier = can.Notifier(manager.bus, [])
    with contextlib.ExitStack() as stack, warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a busy machine: no data for 0.1 s
        motors = [stack.enter_context(TMotorManager_mit_can(row.settings.model, row.settings.id)) for row in way.rows]
        way.begin()
        for _ in ticks(seconds):
            for joint, motor in enumerate(motors):
                (q, dq), (kp, kd) = way.at(joint), gains(joint)
                motor.set_impedance_gains_real_unit_full_state_feedback(K=kp, B=kd)
                motor.set_output_angle_radians(q)
                motor.set_output_velocity_radians_per_second(dq)
                motor.update()
    manager.notifier.stop()
    manager.bus.shutdown()


def robstride(way: Way, channel: str, seconds: float) -> None:
    """robstride for enabling and feedback; motion commands (type 1) by chapter 4 of the manual."""
    from robstride.client import Client

    bounds = {
        "RS00": (33, 14, 500, 5),
        "RS03": (20, 60, 5000, 100),
        "RS05": (50, 5.5, 500, 5),
        "RS06": (50, 36, 5000, 100),
    }

    def u16(value: float, most: float, least: float) -> int:
        return round((value - least) / (most - least) * 65535)

    host = 0xAA
    to_host = [{"can_id": host, "can_mask": 0xFF, "extended": True}]  # udp_multicast gives back what one sends
    with can.Bus(interface="udp_multicast", channel=channel, can_filters=to_host) as bus:
        client = Client(bus, host_can_id=host)
        for row in way.rows:
            drive = row.settings.id
            bus.send(
                can.Message(
                    arbitration_id=18 << 24 | host << 8 | drive,
                    data=bytes.fromhex("2870000020a10700"),
                    is_extended_id=True,
                )
            )
            client._recv()  # canTimeout 500000 = 25 s
            client.enable(drive)
        way.begin()
        for _ in ticks(seconds):
            for joint, row in enumerate(way.rows):
                v, t, kp, kd = bounds[row.settings.model]
                (q, dq), (stiff, damp) = way.at(joint), gains(joint)
                data = struct.pack(
                    ">4H", u16(q, 12.57, -12.57), u16(dq, v, -v), u16(stiff, kp, 0.0), u16(damp, kd, 0.0)
                )
                number = 1 << 24 | u16(0.0, t, -t) << 8 | row.settings.id
                bus.send(can.Message(arbitration_id=number, data=data, is_extended_id=True))
                client._parse_feedback_resp(client._recv(), row.settings.id, 1)


async def moteus(way: Way, channel: str, seconds: float) -> None:
    """moteus, on CAN FD."""
    import moteus

    transport = moteus.PythonCan(interface="udp_multicast", channel=channel, fd=True)
    controllers = [moteus.Controller(id=row.settings.id, transport=transport) for row in way.rows]

    async def command() -> None:
        orders = []
        for joint, controller in enumerate(controllers):
            q, dq = way.at(joint)
            orders.append(
                controller.make_position(
                    position=q / TURN, velocity=dq / TURN, maximum_torque=20.0, watchdog_timeout=10.0, query=True
                )
            )
        await transport.cycle(orders)

    way.begin()
    await paced(command, seconds)
    for controller in controllers:
        await controller.set_stop()
    transport.close()


async def odrive(way: Way, channel: str, seconds: float) -> None:
    """odrive-can: one object an axis, all on one bus, whose frames the first reads."""
    from odrive_can.odrive import ODriveCAN

    bus = can.Bus(interface="udp_multicast", channel=channel)
    axes = [ODriveCAN(axis_id=row.settings.node, can_bus=bus) for row in way.rows]
    await asyncio.wait_for(axes[0].start(), 60.0)
    way.begin()

    async def command() -> None:
        for joint, axis in enumerate(axes):
            axis.set_input_pos(way.at(joint)[0] / TURN)
        if axes[0].axis_state != "CLOSED_LOOP_CONTROL":
            for axis in axes:
                axis.clear_errors()
                axis.set_controller_mode("POSITION_CONTROL", "PASSTHROUGH")
                axis.set_axis_state_no_wait("CLOSED_LOOP_CONTROL")

    await paced(command, seconds)
    axes[0].stop()


async def paced(command: Callable[[], Awaitable[None]], seconds: float) -> None:
    """`ticks` for a coroutine."""
    due = time.monotonic()
    end = due + seconds
    while due < end:
        await command()
        due += 1 / RATE
        await asyncio.sleep(max(0.0, due - time.monotonic()))


def cia402(way: Way, channel: str, seconds: float) -> None:
    """canopen: state machine and mode by SDO, targets by PDO with SYNC, mapped as the arm file's recorder expects."""
    import canopen

    network = canopen.Network()
    network.connect(interface="udp_multicast", channel=channel)
    nodes = [network.add_node(row.settings.node, bundled_path()) for row in way.rows]
    for node in nodes:
        inputs = canopen.objectdictionary.ODRecord("Analog inputs", 0x3160)
        torque = canopen.objectdictionary.ODVariable("Joint torque", 0x3160, 1)
        torque.data_type = canopen.objectdictionary.INTEGER16
        inputs.add_member(torque)
        node.object_dictionary.add_object(inputs)
    unit = TURN / 2**20
    for node in nodes:
        node.sdo.RESPONSE_TIMEOUT = 5.0
        node.nmt.state = "PRE-OPERATIONAL"
        node.sdo[0x6060].raw = 8
        node.rpdo.read()
        node.tpdo.read()
        map_pdos(node)
    targets = [node.rpdo[1]["Target position"] for node in nodes]
    controls = [node.rpdo[1]["Controlword"] for node in nodes]
    for node, target in zip(nodes, targets, strict=True):
        target.raw = node.sdo[0x6064].raw
        node.nmt.state = "OPERATIONAL"
    for word in (0x80, 0x06, 0x07, 0x0F):
        for control in controls:
            control.raw = word
        for _ in ticks(0.3):
            send(network, nodes)
    way.begin()
    for _ in ticks(seconds):
        for joint, target in enumerate(targets):
            target.raw = round(way.at(joint)[0] / unit)
        send(network, nodes)
    network.disconnect()


def send(network: Any, nodes: list[Any]) -> None:
    for node in nodes:
        node.rpdo[1].transmit()
    network.sync.transmit()


def map_pdos(node: Any) -> None:
    """RPDO1: control word and targets; TPDO1: position and torque input; TPDO2: status word, motor torque, velocity."""
    for pdo, entries in (
        (node.rpdo[1], (0x6040, 0x6071, 0x607A)),
        (node.tpdo[1], (0x6064, (0x3160, 1))),
        (node.tpdo[2], (0x6041, 0x6077, 0x606C)),
    ):
        pdo.clear()
        for entry in entries:
            pdo.add_variable(*(entry if isinstance(entry, tuple) else (entry,)))
        pdo.trans_type, pdo.enabled = 1, True
        pdo.save()


HOSTS: dict[str, Callable[[Way, str, float], Any]] = {
    "six-damiao": damiao,
    "six-robstride": robstride,
    "six-cubemars": cubemars,
    "six-moteus": moteus,
    "six-odrive": odrive,
    "six-cia402": cia402,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("arm", help="file of one of the bundled six-joint arms, or its name")
    parser.add_argument("family", choices=HOSTS)
    parser.add_argument("channel")
    parser.add_argument("--seconds", type=float, default=600.0)
    asked = parser.parse_args()
    done = HOSTS[asked.family](Way(asked.arm), asked.channel, asked.seconds)
    if done is not None:
        asyncio.run(done)


if __name__ == "__main__":
    main()
