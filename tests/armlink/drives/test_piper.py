"""AgileX Piper arms: their frames, what is read of them, when they are commanded, and beside their own host."""

import math
import struct
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from bench import Bench
from wiretap import Tap

from armlink.arm_file import bundled_arms, load_arm, parse_arm
from armlink.bus.port import REMOTE
from armlink.drives.board import Board
from armlink.drives.mit_packing import MitCommand
from armlink.drives.orders import Mode, Power
from armlink.drives.piper import frames
from armlink.drives.piper.drives import find_drives
from armlink.errors import BusFault, Refused
from armlink.link.link import Link
from armlink.link.listener import Listener
from armlink.recording.recorder import Recorder
from armlink.selftest.scale_motion import judge_by_listening
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

KP, KD = 10.0, 0.8
"""Those that the SDK recommends [N·m/rad], [N·m·s/rad]."""
RATE = 200


def mit(position=0.0, velocity=0.0, kp=0.0, kd=0.0, torque=0.0) -> bytes:
    """As `JointMitCtrl` of piper_sdk packs it, which rounds towards the lower end."""

    def steps(value, low, high, bits):
        return int((value - low) * float((1 << bits) - 1) / (high - low))

    q, v = steps(position, -12.5, 12.5, 16), steps(velocity, -45, 45, 12)
    p, d, t = steps(kp, 0, 500, 12), steps(kd, -5, 5, 12), steps(torque, -8, 8, 8)
    head = [q >> 8, q & 0xFF, v >> 4, (v & 0xF) << 4 | p >> 8, p & 0xFF, d >> 4, (d & 0xF) << 4 | t >> 4]
    check = 0
    for byte in head:
        check ^= byte
    return bytes([*head, (t & 0xF) << 4 | check & 0xF])


def with_firmware(firmware):
    """The bundled arm as a file with this firmware has it."""
    path = bundled_arms()["six-piper"]
    return parse_arm(yaml.safe_load(path.read_text(encoding="utf-8").replace("S-V1.6-3", firmware)), path)


# ---- frames


def test_an_mit_command_by_hand():
    data = mit(1.0, -2.0, 30.0, 0.5, 1.5)
    assert data.hex() == "8a3c7a40f58cc97c"
    command = frames.unpack_mit(data)
    assert tuple(command) == pytest.approx((1.0, -2.0, 30.0, 0.5, 1.5), abs=0.13)
    assert frames.unpack_mit(data[:7] + bytes([data[7] ^ 1])) is None
    assert frames.unpack_mit(mit()).kd == 0.0


def test_an_mit_command_beside_the_stock_client():
    sdk = pytest.importorskip("piper_sdk")
    sent = []
    client = sdk.C_PiperInterface_V2("nowhere", judge_flag=False, can_auto_init=False)
    client._C_PiperInterface_V2__arm_can = SimpleNamespace(
        SendCanMessage=lambda can_id, data: sent.append((can_id, bytes(data))), CAN_STATUS=SimpleNamespace()
    )
    client._C_PiperInterface_V2__arm_can.CAN_STATUS.SEND_MESSAGE_SUCCESS = None
    for values in ((1.0, -2.0, 30.0, 0.5, 1.5), (-3.0, 0.0, 500.0, 5.0, -8.0)):
        client.JointMitCtrl(3, *values)
    assert sent == [(0x15C, mit(1.0, -2.0, 30.0, 0.5, 1.5)), (0x15C, mit(-3.0, 0.0, 500.0, 5.0, -8.0))]


def test_feedback_by_hand():
    assert frames.unpack_positions(bytes.fromhex("00015F90FFFEA070")) == pytest.approx((math.pi / 2, -math.pi / 2))
    assert frames.unpack_motion(bytes.fromhex("FF9C03E800000000")) == pytest.approx((-0.1, 1.0))
    assert frames.unpack_state(bytes.fromhex("00F0001F21400000")) == (33.0, 0x40)
    assert frames.fault_text(0x40 | 0x20 | 0x01) == "low voltage, drive error (state 61h)"
    assert frames.firmware_in(iter([b"H-V1.2-1", b"\0S-V1.6-", b"3\0"])) == "S-V1.6-3"


@pytest.mark.parametrize(
    ("joint", "firmware", "factor"), [(1, "S-V1.5-8", 4), (3, "S-V1.8-2", 4), (4, "S-V1.5-8", 1), (2, "S-V1.8-3", 1)]
)
def test_torques_of_old_firmware_are_scaled_by_four_at_the_first_three_joints(joint, firmware, factor):
    assert frames.amplification(joint, firmware) == factor


# ---- reading


def test_a_command_is_packed_as_the_stock_client_packs_it_but_rounded_to_the_nearest_step():
    grid = frames.PiperGrid(1.0)
    for values in ((1.0, -2.0, 30.0, 0.5, 1.5), (-3.0, 0.0, 500.0, 5.0, -8.0), (12.5, 45.0, 0.0, 0.02, 8.0)):
        packed = grid.steps(MitCommand(*values))
        told = tuple(frames.unpack_mit(frames.pack_mit(*packed)))
        assert told == pytest.approx(tuple(grid.command(*packed)))
        assert told == pytest.approx(values, abs=500 / 4095 / 2 + 1e-9)
        theirs = frames.unpack_mit(mit(*values))
        steps = (25 / 65535, 90 / 4095, 500 / 4095, 10 / 4095, 16 / 255)
        assert (np.abs(np.subtract(told, theirs)) <= np.array(steps) + 1e-9).all()


def test_no_kd_pushes():
    for kd in (0, 1, 2047):
        assert frames.unpack_mit(frames.pack_mit(0, 0, 0, kd, 0)).kd > 0.0
        assert int.from_bytes(frames.pack_mit(0, 0, 0, kd, 0), "big") >> 23 & 1  # the sign of kd, as the drive has it


def test_who_it_is_and_where_it_stands():
    bench = Bench("six-piper")
    found = bench.drives.identify(bench)
    assert [(each.present, each.firmware, each.mismatch) for each in found] == [(True, "S-V1.6-3", "")] * 6
    assert bench.drives.positions(bench) == pytest.approx(list(bench.arm.plant.position), abs=2e-3)
    assert "keeps on with its last command" in bench.set_up()[0].notes[0]
    assert {can_id for can_id, _ in bench.log} == {0x4AF}
    bench.simulated[0].firmware = "S-V1.9-0"
    assert "its firmware is S-V1.9-0, the arm file states S-V1.6-3" in bench.drives.identify(bench)[2].mismatch
    with pytest.raises(Refused, match=r"base: the arm's firmware is S-V1\.9-0"):
        bench.set_up()


def test_an_arm_with_power_is_not_set_up_since_it_would_fall():
    bench = Bench("six-piper")
    bench.set_up()
    assert bench.walk()
    with pytest.raises(Refused, match=r"base: the arm has power: .* support the arm"):
        Bench.set_up(bench)
    assert all(bench.powered)


def test_a_joint_has_a_command_to_hold_before_it_can_sink():
    bench = Bench("six-piper")
    bench.set_up()
    bench.log.clear()
    bench.walk()
    ids = [can_id for can_id, data in bench.log if can_id != 0x151]
    assert ids[:4] == [0x471, 0x15A, 0x471, 0x15B]


def test_a_joint_that_left_the_arms_own_bus_is_silent_although_its_position_comes():
    bench = Bench("six-piper")
    bench.set_up()
    bench.walk()
    bench.simulated[4].unplugged = True  # the arm goes on to send the position of the pair
    for _ in range(10):
        bench.board.position = [math.nan] * 6
        bench.cycle([bench.order(j, position=bench.position[j]) for j in range(6)])
    bench.fast = bench.drives.fill(board := Board(6), range(6))
    bench.cycle([bench.order(j, position=bench.position[j]) for j in range(6)])
    assert [position == position for position in board.position] == [True] * 4 + [False, True]


def test_an_arm_that_left_the_mode_of_its_commands_is_a_fault():
    bench = Bench("six-piper")
    bench.set_up()
    bench.walk()
    for joint in bench.simulated:
        joint.mode = 1
    for _ in range(10):
        bench.cycle([bench.order(j, position=bench.position[j]) for j in range(6)])
    assert "power is stopped, expected on" in str(bench.drives.fault([Mode.POSITION] * 6, bench.arm.time))


@pytest.mark.parametrize("mode", [Mode.POSITION, Mode.TORQUE])
def test_what_a_keeper_sends_holds_the_arm_where_it_stands(mode):
    """Under load, and without any command after it: nothing falls."""
    bench = Bench("six-piper")
    bench.set_up()
    bench.walk()
    start = bench.position
    for _ in range(100):  # it carries itself in another pose
        bench.cycle([bench.order(j, position=start[j] - 0.3 * (j == 1)) for j in range(6)])
    carried = bench.arm.plant.motor_torque.copy()
    for _ in range(3):
        bench.cycle([bench.order(j, mode=mode, torque=carried[j] * (mode == Mode.TORQUE)) for j in range(6)])
    for joint in range(6):
        for frame in bench.drives.safe_frames(joint):
            bench.send(*frame)
    before = bench.arm.plant.position.copy()
    bench.arm.advance(5.0)
    assert np.abs(bench.arm.plant.position - before).max() < 0.05
    assert np.abs(bench.arm.plant.velocity).max() < 0.02
    assert all(bench.powered)


def test_a_joint_without_power_has_nothing_to_send():
    bench = Bench("six-piper")
    bench.set_up()
    assert [list(bench.drives.safe_frames(j)) for j in range(6)] == [[]] * 6
    bench.walk()
    assert all(bench.drives.safe_frames(j) for j in range(6))
    bench.walk(Power.OFF)
    assert [list(bench.drives.safe_frames(j)) for j in range(6)] == [[]] * 6


def test_a_silent_arm():
    bench = Bench("six-piper")
    bench.arm.outbox.clear()
    bench.simulated[4].unplugged = True
    assert [each.present for each in bench.drives.identify(bench)] == [True] * 4 + [False, True]
    with pytest.raises(BusFault, match="wrist_2: no message from joint 5"):
        bench.set_up()


def test_without_a_keeper_it_gets_no_power():
    arm = load_arm("six-piper")
    arm = arm.model_copy(update={"link": arm.link.model_copy(update={"keeper": False})})
    simulated = SimulatedArm(arm, Truth.of(arm))
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        with pytest.raises(Refused, match=r"base: if this host dies, the drive continues .* `link.keeper: true`"):
            link.enable()
    assert not any(simulated.device(joint).motor.powered for joint in range(6))


def test_faults_of_a_joint_and_of_the_arm():
    bench = Bench("six-piper")
    bench.set_up()
    bench.drives.take(0x2A1, bytes([1, 7, 1, 0, 0, 0, 0, 0]), 0.0)
    reading = bench.drives.take(0x261, bytes.fromhex("00F0001F21400000"), 0.0)
    assert (reading.power, reading.fault, reading.temperature) == (Power.FAULT, "collision", 33.0)
    bench.drives.take(0x2A1, bytes([1, 0, 4, 0, 0, 0, 0, 0]), 0.0)
    assert bench.drives.take(0x261, bytes.fromhex("00F0001F21400000"), 0.0).power is Power.ON
    assert bench.drives.take(0x262, bytes.fromhex("00F0001F21100000"), 0.0).fault == "collision (state 10h)"


def test_any_bytes():
    bench = Bench("six-piper")
    bench.set_up()
    random = np.random.default_rng(3)
    known = [*bench.drives.routes(), *bench.drives.commands()]
    for _ in range(3000):
        can_id, data = int(random.choice(known)), random.bytes(int(random.integers(9)))
        reading = bench.drives.take(can_id, data, 0.0)
        assert reading is None or 0 <= reading.joint < 6
        assert all(-1 <= joint < 6 for joint, _ in bench.drives.commands_of(can_id, data))
        if can_id in bench.fast:
            bench.fast[can_id](data)
        bench.drives.fault([8] * 6, 0.0)


def test_commands_of_its_host():
    drives = Bench("six-piper").drives
    ((joint, order),) = drives.commands_of(0x15B, mit(0.5, 0.0, 30.0, 1.0, 1.0))
    assert (joint, order.mode) == (1, Mode.POSITION)
    assert order.torque == pytest.approx(4.0, abs=0.26)
    targets = drives.commands_of(0x156, struct.pack(">ii", 90_000, -45_000))
    assert [(joint, round(math.degrees(order.position))) for joint, order in targets] == [(2, 90), (3, -45)]
    ((joint, order),) = drives.commands_of(0x471, bytes([0xFF, 2, 0, 0, 0, 0, 0, 0]))
    assert (joint, order.power) == (-1, Power.ON)
    assert drives.commands_of(0x150, bytes([1] + [0] * 7))[0][1].power is Power.STOPPED
    assert drives.commands_of(0x159, bytes(8)) == []  # the hand


def test_it_is_found_by_what_it_sends():
    bench = Bench("six-piper")
    bench.wait(lambda: False, 0.1)
    heard = bench.heard
    searched = SimpleNamespace(heard=heard, __call__=None)
    ask = type("Ask", (), {"heard": heard, "__call__": lambda self, *args, **keys: "S-V1.6-3"})()
    assert [each.drive for each in find_drives(ask)] == [{"joint": n, "firmware": "S-V1.6-3"} for n in range(1, 7)]
    searched.heard = [frame for frame in heard if frame[0] != 0x256]
    assert find_drives(searched) == []


# ---- beside its host


def talk(seconds, command):
    """Frames of the bundled arm and of a host that sends `command(joint, t)` to each joint, at 200 Hz."""
    arm = load_arm("six-piper")
    simulated = SimulatedArm(arm, Truth.of(arm), 1)
    start = simulated.plant.position.copy()
    said = []

    def send(t, can_id, data):
        said.append((t, can_id, data))
        simulated.on_frame(can_id, data)

    send(100.0, 0x151, bytes([1, 4, 100, 0xAD, 0, 0, 0, 0]))
    for joint in range(1, 7):
        send(100.0, 0x471, bytes([joint, 2, 0, 0, 0, 0, 0, 0]))
    for cycle in range(round(seconds * RATE)):
        t = cycle / RATE
        for joint in range(6):
            send(100.0 + t, 0x15A + joint, command(joint, t, start))
        simulated.advance(1 / RATE)
        while simulated.outbox:
            can_id, data = simulated.outbox.popleft()
            if not can_id & REMOTE:
                said.append((100.0 + t + 0.002, can_id, data))
    return said


def swing(joint, t, start):
    omega = 4.0 + 0.3 * joint
    side = -1.0 if joint == 3 else 1.0  # away from its stop
    way = 0.3 * side * (1 - math.cos(omega * t))
    return mit(start[joint] + way, 0.3 * side * omega * math.sin(omega * t), KP, KD)


def test_a_recording_beside_its_host_has_readings_and_commands():
    rows = [row for _, row in Recorder(load_arm("six-piper"), Tap(talk(1.0, swing))).rows(1.2)]
    assert len(rows) > 150
    last = rows[-1]
    assert np.isfinite(last["position"]).all()
    error = last["position_command"] - last["position"]
    assert last["torque_command"] == pytest.approx(KP * error, abs=1.0)


def test_the_hidden_factor_of_four_is_found_by_listening():
    """The arm file states a firmware that scales no torques; the arm has one that does. Wrists carry too little."""
    said = talk(6.0, swing)
    for firmware, found in (("S-V1.6-3", [[]] * 3), ("S-V1.8-3", [[(("torque",), 4)]] * 3)):
        with Listener(with_firmware(firmware), Tap(said)) as listener:
            judged = judge_by_listening(listener, lambda text: None, 6.0)[:3]
        told = [[(one.quantities, round(1 / one.factor)) for one in joint.findings] for joint in judged]
        assert told == found
