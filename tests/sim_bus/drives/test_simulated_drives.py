"""Simulated drives of several families on one arm, their torque constants and their firmware faults."""

import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from serving import pendulum

from armlink.arm_file import parse_arm
from armlink.bus.port import CLASSICAL, EXTENDED
from armlink.drives.damiao import frames as damiao
from armlink.drives.mit_packing import MitCommand, Ranges, Special, grid_of, pack_command, special
from armlink.errors import BadInput
from sim_bus.bus.fault_injector import Injector
from sim_bus.bus.fault_kinds import parse_fault
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.drives.drive_faults import DRIVE_KINDS
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

DAMIAO = {"family": "damiao", "id": 2, "reply": 0x12, "model": "DM4340", "kp": 40, "kd": 1.0}
DM4340 = grid_of(Ranges(12.5, 10.0, 28.0))
FAMILIES = [
    DAMIAO,
    {"family": "cubemars", "id": 6, "model": "AK80-9", "can_timeout": 4000, "kp": 40, "kd": 1.0},
    {"family": "robstride", "id": 3, "model": "RS01", "kp": 40, "kd": 1.0},
    {"family": "moteus", "id": 4},
    {"family": "odrive", "node": 5},
]


def simulated(drive, truth=None):
    arm = pendulum(drive)
    return SimulatedArm(arm, truth(Truth.of(arm)) if truth else Truth.of(arm))


def ask(arm, data, can_id=2):
    arm.outbox.clear()
    arm.on_frame(can_id, data)
    return [damiao.unpack_reply(data, DM4340) for _, data in arm.outbox]


def command(**values):
    fields = {"position": 0.0, "velocity": 0.0, "kp": 0.0, "kd": 0.0, "torque": 0.0} | values
    return pack_command(MitCommand(**fields), DM4340)


ENABLE = special(Special.ENABLE)


# ---- identifiers by the makers' manuals, which the host's code and the simulation share


def test_a_robstride_drive_tells_host_feh_who_it_is():
    arm = simulated({"family": "robstride", "id": 3, "model": "RS01", "kp": 40, "kd": 1.0})
    arm.on_frame(0x0000FD03 | EXTENDED, bytes(8))
    assert [can_id for can_id, _ in arm.outbox] == [0x000003FE | EXTENDED]


def test_a_robstride_drive_that_no_host_has_asked_sends_its_fault_of_the_encoder_to_host_fdh():
    arm = simulated({"family": "robstride", "id": 3, "model": "RS01", "kp": 40, "kd": 1.0})
    arm.device(0).lose_feedback()
    arm.on_frame(0x0300FD03 | EXTENDED, bytes(8))
    ((can_id, _),) = arm.outbox
    assert (can_id & 0x1F00FFFF, can_id >> 16 & 0x3F) == (0x020003FD, 0b001000)


def test_a_damiao_drive_hears_the_identifiers_of_all_its_modes():
    drive = simulated(DAMIAO).device(0)
    assert [each for each in range(0x800) if drive.takes(each)] == [0x002, 0x102, 0x202, 0x302, 0x7FF]


# ---- several families on one arm


def mixed():
    drives = [
        {"family": "canopen", "node": 5},
        DAMIAO,
        {"family": "robstride", "id": 3, "model": "RS01", "kp": 40, "kd": 1.0},
        {"family": "cubemars", "id": 6, "model": "AK80-9", "kp": 40, "kd": 1.0},
        {"family": "moteus", "id": 0x21},
        {"family": "odrive", "node": 20, "gear": 8.0},
    ]
    names = [f"j{number}" for number in range(len(drives))]
    body = {"mass": 0.2, "com": [0.05, 0.0, 0.0], "inertia": [1e-3, 1e-3, 1e-3]}
    return parse_arm(
        {
            "name": "mixed",
            "kinematics": {"joints": [{"name": name, "a": 0.1, "lower": -2.0, "upper": 2.0} for name in names]},
            "link": {
                "joints": [
                    {"name": name, "drive": drive, "rated_torque": 10.0, "max_torque": 20.0}
                    for name, drive in zip(names, drives, strict=True)
                ]
            },
            "sim": {"links": [body] * len(names), "sensors": {"noise": [0.0] * len(names)}},
        },
        Path("mixed.yaml"),
    )


def test_each_drive_of_a_mixed_arm_answers_its_own_frames():
    arm = mixed()
    simulated = SimulatedArm(arm, Truth.of(arm))
    simulated.outbox.clear()
    read_mode = bytes.fromhex("110050")
    for can_id, data, answer in (
        (0x605, bytes.fromhex("4000100000000000"), 0x585),
        (0x002, special(Special.CLEAR_ERROR), 0x12),
        (0x8300FD03, bytes(8), 0x828003FD),
        (0x006, special(Special.DISABLE), 0x000),
        (0x80008021, read_mode, 0x80002100),
        (0x40000280, bytes(8), 0x280),
    ):
        simulated.on_frame(can_id, data)
        assert [came for came, _ in simulated.outbox] == [answer]
        simulated.outbox.clear()
        assert simulated.joint_of(answer) is not None
    simulated.advance(0.1)  # heartbeat and estimates of the ODrive, by its own clock
    assert {came >> 5 for came, _ in simulated.outbox} == {20}


def test_the_clock_of_the_host_drives_time_where_there_is_no_sync():
    bus = LockStepBus("six-damiao")
    before = bus.arm.time
    bus.open_port().pass_time(0.004)
    assert bus.arm.time == pytest.approx(before + 0.004)
    bus.send(can.Message(arbitration_id=1, data=ENABLE, is_extended_id=False))
    assert bus.recv(0.0).arbitration_id == 0x11
    bus.shutdown()


def test_29_bits_and_can_fd_pass_the_lock_step_bus():
    bus = LockStepBus("six-moteus")
    data = bytes.fromhex("1100" + "1f01") + b"\x50" * 4
    bus.send(can.Message(arbitration_id=0x800B, data=data, is_fd=True))
    answer = bus.recv(0.0)
    assert (answer.arbitration_id, answer.is_extended_id, answer.is_fd) == (0x0B00, True, True)
    bus.shutdown()


# ---- torque is current times a torque constant


def test_a_wrong_torque_constant_shows_in_reading_and_command_alike():
    """Reading v = gain·τ + offset; asked for v, the drive makes τ = (v − offset) / gain."""
    gain, offset = 1.25, 0.4
    arm = simulated(DAMIAO, lambda truth: replace(truth, gain=np.array([gain]), offset=np.array([offset])))
    ask(arm, ENABLE)
    ask(arm, command(torque=2.0))
    arm.advance(0.001)
    made = float(arm.plant.motor_torque[0])
    assert made == pytest.approx((2.0 - offset) / gain, abs=0.01)
    assert ask(arm, command(torque=2.0))[0].feedback.torque == pytest.approx(2.0, abs=0.01)
    arm.drift(0, 1.1, 0.0)
    ask(arm, command(torque=2.0))
    arm.advance(0.001)
    assert float(arm.plant.motor_torque[0]) == pytest.approx((2.0 - offset) / (1.1 * gain), abs=0.01)


def test_without_power_a_joint_is_free_and_it_makes_no_torque():
    arm = simulated({**DAMIAO, "zero": 0.3, "direction": -1})
    ask(arm, ENABLE)
    for _ in range(200):
        reply = ask(arm, command(position=0.0, kp=100.0, kd=3.0))[0]
        arm.advance(0.004)
    assert reply.feedback.position == pytest.approx(0.0, abs=0.03)  # sags: 0.3 rad at the joint against gravity
    assert float(arm.plant.position[0]) == pytest.approx(0.3, abs=0.03)
    ask(arm, special(Special.DISABLE))
    arm.advance(0.3)
    assert float(arm.plant.position[0]) < 0.2
    assert abs(ask(arm, damiao.refresh_request(2), damiao.REGISTERS_ID)[0].feedback.torque) < 0.01


def test_the_drive_saturates_at_its_range():
    arm = simulated(DAMIAO)
    ask(arm, ENABLE)
    ask(arm, command(position=12.0, kp=500.0))
    arm.advance(0.001)
    assert float(arm.plant.motor_torque[0]) == pytest.approx(28.0, abs=0.01)


# ---- firmware faults


def injected(text, drive=DAMIAO):
    arm = simulated(drive)
    injector = Injector(arm)
    injector.inject(parse_fault(text, ["hinge"]))
    return arm, injector


def test_scale_faults_code_by_another_range_than_the_registers_say():
    """A factor on the range, so the reading by the registers' range is that much too small, and a command too large."""
    arm, injector = injected("scale.torque:hinge:1.25")
    injector.on_frame(2, ENABLE)
    injector.on_frame(2, command(torque=2.0))
    injector.advance(0.001)
    assert float(arm.plant.motor_torque[0]) == pytest.approx(2.5, abs=0.01)
    injector.outbox.clear()
    injector.on_frame(2, command(torque=2.0))
    assert damiao.unpack_reply(injector.outbox[0][1], DM4340).feedback.torque == pytest.approx(2.0, abs=0.01)
    assert arm.drive_at[0].registers[23] == 28.0


def test_an_answer_in_classical_frames_is_marked():
    _, injector = injected("drive.classic:hinge")
    injector.on_frame(2, ENABLE)
    assert [can_id & CLASSICAL for can_id, _ in injector.outbox] == [CLASSICAL]


def test_a_watchdog_that_does_nothing_keeps_on():
    arm, _ = injected("watchdog.off:hinge")
    arm.on_frame(damiao.REGISTERS_ID, damiao.write_request(2, 9, 2000))
    ask(arm, ENABLE)
    arm.advance(0.5)
    assert arm.drive_at[0].motor.powered


@pytest.mark.parametrize("drive", FAMILIES, ids=lambda drive: drive["family"])
def test_every_firmware_fault_begins_and_ends_on_every_family(drive):
    arm = simulated(drive)
    injector = Injector(arm)
    for fault in DRIVE_KINDS:
        injector.inject(parse_fault(f"{fault}:hinge", arm.names))
        injector.advance(0.02)
        assert fault in arm.device(0).faults
        injector.clear()
        assert not arm.device(0).faults
        arm.reboot(0)
        injector.advance(0.01)
        assert not arm.device(0).motor.powered


def test_silence_and_reboot_of_a_drive():
    arm, injector = injected("node.silent:hinge:0.1")
    injector.on_frame(2, ENABLE)
    assert not injector.outbox
    injector.advance(0.2)
    injector.on_frame(2, ENABLE)
    assert [can_id for can_id, _ in injector.outbox] == [0x12]
    injector.inject(parse_fault("node.reboot:hinge", ["hinge"]))
    assert arm.drive_at[0].state is damiao.DamiaoStatus.DISABLED


def test_frames_of_a_drive_are_spoilt_too():
    _, injector = injected("frame.short:hinge")
    injector.on_frame(2, ENABLE)
    assert [len(data) for _, data in injector.outbox] == [3]


@pytest.mark.parametrize(
    ("drive", "fault"), [(DAMIAO, "sdo.abort:hinge"), ({"family": "canopen", "node": 2}, "drive.trip:hinge")]
)
def test_a_fault_that_a_drive_cannot_have(drive, fault):
    with pytest.raises(BadInput, match=f"hinge has a {drive['family']} drive"):
        injected(fault, drive)


def test_a_drive_without_a_model_on_its_label_is_not_simulated():
    with pytest.raises(BadInput, match=r"hinge: drive\.model '' cannot be simulated; the simulated models are DM3507"):
        simulated({**DAMIAO, "model": ""})


# ---- the command


@pytest.mark.long
def test_armlink_sim_serves_drives_of_a_family_on_a_bus():
    channel = "239.74.163.93"
    command_line = [sys.executable, "-c", "from armlink.cli import main; main()", "sim", "six-damiao"]
    options = ["--bus", f"udp_multicast:{channel}", "--fault", "drive.trip:elbow"]
    with subprocess.Popen([*command_line, *options], stderr=subprocess.PIPE, text=True) as process:
        try:
            assert "6 joints, ids 01h, 02h, 03h" in process.stderr.readline()
            with can.Bus(interface="udp_multicast", channel=channel) as bus:
                found = {}
                for _ in range(200):
                    for drive in (1, 3):
                        request = struct.pack("<HB5x", drive, 0xCC)
                        bus.send(can.Message(arbitration_id=0x7FF, data=request, is_extended_id=False))
                    while (message := bus.recv(0.05)) is not None:
                        if message.arbitration_id in (0x11, 0x13):
                            found[message.arbitration_id] = message.data[0] >> 4
                    if len(found) == 2:
                        break
            assert found == {0x11: 0x0, 0x13: 0xD}
        finally:
            process.terminate()
            process.communicate(timeout=30)


# ---- the torque that a drive tells


def test_a_stiff_drive_tells_the_mean_torque_of_a_step():
    """Its target stands still for each step while the joint moves on: momentum changes by what it told, less gravity's
    part."""
    arm = simulated(DAMIAO)
    motor, plant, step = arm.device(0).motor, arm.plant, 0.004
    inertia, told, fallen, speed = 0.01 + 0.2**2, 0.0, 0.0, 0.8
    for k in range(100):
        before = plant.position[0]
        motor.impede(300.0, 30.0, speed * step * (k + 1), speed, 0.0)
        arm.advance(step)
        told += step * motor.torque
        fallen += step * 9.81 * 0.2 * np.sin((before + plant.position[0]) / 2)
    assert plant.position[0] == pytest.approx(speed * step * 100, abs=0.02)
    assert told - fallen == pytest.approx(inertia * plant.velocity[0], abs=2e-3)
