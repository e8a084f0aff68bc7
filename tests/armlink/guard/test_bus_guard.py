"""The guard of a bus: what a link sends in its work passes, what a program sends beyond a limit does not."""

import ast
import copy
import json
import math
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from compromised import (
    COMMAND,
    CONTENT,
    ENABLED_AT,
    HEARD,
    MAX_TORQUE,
    PERIOD,
    RATED,
    SPEED,
    UNIT,
    WINDOW,
    Joints,
    N,
    content_of,
    guarded,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from armlink.drives.canopen import object_dictionary as objects
from armlink.guard import bus_guard
from armlink.guard.bus_guard import BATCH, BusGuard, Field, GuardPort, Policy, PolicyError, Source
from armlink.link.types import Calibration, Command

POSITION, TORQUE = 8, 10


def command(mode, torque=0.0, position=0.0):
    return Command(np.full(N, mode, np.int8), np.full(N, torque), np.full(N, position))


def test_numbers_of_the_kernel_and_the_schema_are_what_they_are_elsewhere():
    flags = bus_guard.EXTENDED, bus_guard.REMOTE, bus_guard.ERROR
    assert flags == (socket.CAN_EFF_FLAG, socket.CAN_RTR_FLAG, socket.CAN_ERR_FLAG)
    assert (bus_guard.FD_FLAGS, bus_guard.SCHEMA) == (5, "armlink.guard/1")
    assert (bus_guard.FRAME.size, bus_guard.FD_FRAME.size) == (16, 72)


def test_all_that_a_link_does_passes():
    bus, link = guarded(CONTENT)
    random = np.random.default_rng(4)
    with link:
        link.scan()
        link.start()
        link.enable()
        link.write_calibration(1, Calibration(1.02, -0.3, 7, 20_000), store=True)
        for _ in range(150):
            for _ in range(6):
                link.cycle(command(POSITION, position=random.uniform(-3, 3)))
            for _ in range(6):
                link.cycle(command(TORQUE, torque=random.uniform(-60, 60)))
        for node in bus.nodes.values():  # moved by hand, without power
            node.position += 4000
        link.disable()
        for node in bus.nodes.values():
            node.position += 90_000
        link.enable()
        link.cycle(command(POSITION, position=0.1))
        link.stop()
    assert bus.refused == []
    assert len(bus.sent) > 3 * 1800


def test_sixty_three_joints_pass():
    bus, link = guarded(content_of(63), 63)
    with link:
        link.start()
        link.enable()
    assert bus.refused == []


def test_a_drive_must_have_acknowledged_its_mapping():
    bus, link = guarded(CONTENT)
    frame = struct.pack("<Hhi", 15, 0, 0)
    assert "acknowledged" in bus.policy.refusal(0x201, frame, 10.0)
    with link:
        link.start()
        link.enable()
        now = bus.clock.time
        assert bus.policy.refusal(0x201, frame, now) == ""
        bus.policy.hear(0x701, b"\x00", now)  # boot-up: the node has the mapping of its maker again
        assert "acknowledged" in bus.policy.refusal(0x201, frame, now)
        assert bus.policy.refusal(0x202, frame, now) == ""


def test_torque_and_position_are_bounded_in_size_and_rate():
    bus, link = guarded(CONTENT)
    with link:
        link.start()
        link.enable()
        now, policy = bus.clock.time, bus.policy

        def refused(torque, position, after=0.0):
            return policy.refusal(0x201, struct.pack("<Hhi", 15, torque, position), now + after)

        most, step = round(MAX_TORQUE / RATED * 1000), SPEED / UNIT
        assert "target torque of joint_1 is 751, allowed are -750 to 750" in refused(751, 0)
        assert "in one frame" in refused(most, 0)
        assert "target position of joint_1" in refused(50, int(WINDOW) + 2)
        assert "in one frame" in refused(50, int(0.1 * step))
        assert refused(50, int(0.015 * step)) == ""
        assert "in one frame" in refused(50, int(0.030 * step), 0.001)
        assert refused(50, int(0.024 * step), 0.012) == ""


def test_a_joint_that_stands_outside_its_window_is_led_back():
    bus, link = guarded(CONTENT)
    for node in bus.nodes.values():
        node.position = int(WINDOW + 0.08 / UNIT)
    with link:
        link.start()
        link.enable()
        for _ in range(200):
            link.cycle(command(POSITION, position=0.0))
    assert bus.refused == []
    outside = struct.pack("<Hhi", 15, 50, int(WINDOW + 0.05 / UNIT))
    assert "target position" in bus.policy.refusal(0x201, outside, bus.clock.time)


@pytest.mark.parametrize(
    ("index", "sub", "code", "value"),
    [
        (0x6072, 0, "H", 1000),  # maximum torque
        (0x607D, 2, "i", 2**30),  # window
        (0x607A, 0, "i", 10_000),  # target position beside the cycle
        (0x6071, 0, "h", 10),
        (0x60FF, 0, "i", 1),
        (0x60B2, 0, "h", 1),  # torque offset
        (0x6060, 0, "b", 3),  # velocity mode
        (0x605A, 0, "h", 0),  # quick stop that lets go
        (0x1600, 2, "I", 0x60FF0020),  # another mapping
        (0x1402, 1, "I", 0x401),  # an RPDO of the program's own
        (0x1016, 1, "I", 0),  # no watch for the host
        (0x1400, 5, "H", 0),
        (0x2100, 4, "f", 40.0),
        (0x2100, 4, "f", math.nan),
        (0x6040, 0, "H", 15),
    ],
)
def test_writes_that_the_set_up_does_not_make_are_refused(index, sub, code, value):
    size = struct.calcsize(code)
    data = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, sub) + struct.pack("<" + code, value).ljust(4, b"\0")
    assert Policy(CONTENT).refusal(0x601, data, 10.0)


def test_segmented_and_block_writes_are_refused():
    policy = Policy(CONTENT)
    for data in ("2172600000000000", "0172600000000000", "c672600002000000", "2272600000000000", "2372"):
        assert policy.refusal(0x601, bytes.fromhex(data), 10.0)
    for data in ("4064600000000000", "8064600000000405", "6000000000000000", "7000000000000000"):  # reads, and an abort
        assert policy.refusal(0x601, bytes.fromhex(data), 10.0) == ""


@pytest.mark.parametrize("length", [0, 1, 4, 7])
def test_a_request_that_is_cut_short_is_refused(length):
    assert Policy(CONTENT).refusal(0x601, bytes.fromhex("4064600000000000")[:length], 10.0)


def test_a_refused_frame_is_named_with_its_bytes():
    policy = Policy(CONTENT)
    assert policy.refusal(0x201, b"", 10.0).startswith("the program sent 201h with no data, ")
    assert policy.refusal(0x201, b"\x0f\x01", 10.0).startswith("the program sent 201h with 0f 01, ")


hostile = st.one_of(
    st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)),
    st.tuples(
        st.sampled_from([0x201, 0x202]),
        st.builds(
            struct.Struct("<Hhi").pack,
            st.integers(0, 0xFFFF),
            st.integers(-900, 900),
            st.one_of(st.integers(-(2**31), 2**31 - 1), st.integers(-400_000, 400_000)),
        ),
    ),
    st.tuples(
        st.sampled_from([0x601, 0x602]),
        st.builds(
            struct.Struct("<BHBi").pack,
            st.sampled_from([0x23, 0x2B, 0x2F, 0x22, 0x21, 0x40, 0xC6]),
            st.sampled_from([entry.index for entry in vars(objects).values() if isinstance(entry, objects.Entry)]),
            st.integers(0, 9),
            st.integers(-(2**31), 2**31 - 1),
        ),
    ),
)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(hostile, st.floats(0, 0.02)), max_size=40))
def test_whatever_a_program_sends_no_joint_is_told_more_than_its_limits(frames):
    joints = Joints()
    for (can_id, data), pause in frames:
        assert joints.send(can_id, data, pause)[1] == ""


steps = st.tuples(
    st.sampled_from([1, 2]),
    st.sampled_from([0x0F, 0x0F, 0x0F, 0x8F, 0x1F, 0x06, 0x80]),
    st.sampled_from([-60, -3, -2, -1, 0, 1, 2, 3, 60]),
    st.one_of(st.integers(-3, 3), st.integers(-8000, 8000)),
    st.sampled_from([0.0, 0.001, 0.004, 0.02]),
)


@settings(max_examples=200, deadline=None)
@given(st.integers(int(-1.2 * WINDOW), int(1.2 * WINDOW)), st.lists(steps, max_size=60))
def test_a_program_gains_nothing_by_small_steps_from_where_the_joint_is(start, frames):
    joints = Joints()
    joints.stand(1, start)
    for node, word, torque, position, pause in frames:
        told = COMMAND.pack(word, joints.torque[node] + torque, joints.position[node] + position)
        assert joints.send(0x200 + node, told, pause)[1] == ""


@pytest.mark.parametrize("count", [1, 2, 3, 700, 2000])
def test_a_joint_outside_its_window_is_not_led_further_out(count):
    joints = Joints()
    joints.stand(1, int(WINDOW) + 5000)
    for _ in range(300):
        joints.send(0x201, COMMAND.pack(0x0F, 0, joints.position[1] + count), PERIOD)
    assert joints.position[1] <= WINDOW + 5001


def test_a_torque_that_the_drive_exceeds_by_itself_is_no_leave_to_ask_for_it():
    joints = Joints()
    joints.policy.hear(0x281, struct.pack("<Hhi", 0x27, 760, 0), ENABLED_AT)
    passed, _ = joints.send(0x201, COMMAND.pack(0x0F, 751, 0))
    assert not passed


@pytest.mark.parametrize("side", [-1, 1])
def test_a_joint_outside_its_window_may_be_held_where_it_stands(side):
    joints, place = Joints(), side * (int(WINDOW) + 5000)
    joints.stand(1, place)
    assert joints.send(0x201, COMMAND.pack(0x0F, 0, place))[0]
    assert not joints.send(0x201, COMMAND.pack(0x0F, 0, place + side), PERIOD)[0]


@pytest.mark.parametrize("data", [b"\x00", b"\x00\x07"])
def test_a_restart_is_known_by_its_first_byte(data):
    joints = Joints()
    joints.policy.hear(0x701, data, joints.now)
    assert "acknowledged" in joints.policy.refusal(0x201, COMMAND.pack(0x0F, 0, 0), joints.now)


def test_only_the_answer_that_means_it_is_an_acknowledgement():
    joints = Joints()
    joints.policy.hear(0x701, b"\x00", joints.now)
    for can_id, prefix in joints.policy.frames[0x201].after:
        joints.policy.hear(can_id, b"\x80" + prefix[1:] + bytes(4), joints.now)  # the node has aborted it
    assert "acknowledged" in joints.policy.refusal(0x201, COMMAND.pack(0x0F, 0, 0), joints.now)


POSITION_FIELD = {"name": "x", "at": 0, "code": "h", "least": -100, "most": 100, "rate": 8, "slack": 4, "first": [0]}
POSITION_FIELD |= {"near": [{"frame": 1, "at": 0, "code": "h"}], "within": 2, "age": 10}


def refusal(field, value, now):
    return field.refusal(struct.pack("<h", value), now)


def test_exactly_what_the_rate_has_room_for_may_come():
    field = Field(POSITION_FIELD)
    assert refusal(field, 0, 0.0) == ""
    field.keep(struct.pack("<h", 0), 0.0)
    assert refusal(field, 4, 0.0) == ""
    assert refusal(field, 5, 0.0)
    field.keep(struct.pack("<h", 4), 0.0)
    assert refusal(field, 6, 0.25) == ""
    assert refusal(field, 7, 0.25)


def test_what_a_policy_leaves_out_gives_no_room():
    field = Field(
        {"name": "x", "at": 0, "code": "f", "least": -9, "most": 9, "rate": 8, "near": POSITION_FIELD["near"]}
    )
    field.see(0.0, 0.0)
    field.keep(struct.pack("<f", 5.0), 0.0)
    assert field.refusal(struct.pack("<f", 0.5), 0.0)
    assert field.refusal(struct.pack("<f", 5.5), 0.0)
    assert field.refusal(struct.pack("<f", 5.5), 1.0)
    assert field.refusal(struct.pack("<f", 0.0), 0.5)  # the reading is too old


def test_only_the_two_newest_readings_are_where_the_joint_is():
    field = Field(POSITION_FIELD)
    field.keep(struct.pack("<h", 0), 0.0)
    for reading in (50, 60, 70):
        field.see(reading, 0.0)
    assert refusal(field, 60, 0.0) == ""
    assert refusal(field, 72, 0.0) == ""
    assert refusal(field, 50, 0.0)
    assert refusal(field, 70, 11.0)


def test_bit_7_of_the_control_word_is_no_way_around_the_rate():
    joints = Joints()
    assert not joints.send(0x201, COMMAND.pack(0x8F, 0, 300_000))[0]
    assert not joints.send(0x201, COMMAND.pack(0x0F, 0, 300_000))[0]


class Side:
    """One side of a guard, without a socket."""

    def __init__(self):
        self.sent, self.full = [], False

    def send(self, can_id, data, fd=False):
        if not self.full:
            self.sent.append((can_id, data))
        return not self.full


def test_the_first_frame_that_is_not_allowed_closes_it_and_stops_the_joints():
    lines, program, wire = [], Side(), Side()
    guard = BusGuard(Policy(CONTENT), program, wire, lines.append)
    guard._to_wire(0x80, b"", False)
    guard._to_wire(0x123, b"\x01", False)
    guard._to_wire(0x80, b"", False)
    assert wire.sent == [(0x80, b""), *((0x600 + node, bytes.fromhex("2b40600002000000")) for node in (1, 2))]
    assert lines == [
        "guard: closed, so it passes no more frames: the program sent identifier 123h, which the policy does not name; "
        "the joints were commanded to stop; start the guard again to open it"
    ]
    guard._to_program(0x181, bytes(8), False)
    assert program.sent == [(0x181, bytes(8))]


@pytest.mark.parametrize(
    ("flag", "said"),
    [
        (bus_guard.REMOTE, "the program sent 80h as a remote or error frame, which no policy allows"),
        (bus_guard.ERROR, "the program sent 80h as a remote or error frame, which no policy allows"),
        (bus_guard.EXTENDED, "the program sent identifier 80000080h, which the policy does not name"),
    ],
)
def test_remote_error_and_extended_frames_do_not_pass(flag, said):
    wire = Side()
    guard = BusGuard(Policy(CONTENT), Side(), wire, lambda text: None)
    guard._to_wire(0x80 | flag, b"", False)
    assert guard.closed == said
    assert (0x80 | flag, b"") not in wire.sent


def test_a_wire_that_takes_nothing_closes_it():
    wire = Side()
    wire.full = True
    guard = BusGuard(Policy(CONTENT), Side(), wire, lambda text: None)
    guard._to_wire(0x80, b"", False)
    assert guard.closed.startswith("the wire takes no frames")


class Wire:
    """A port on one end of a socket pair, and the other end."""

    def __init__(self):
        own, self.other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        own.setblocking(False)
        self.other.settimeout(5)
        self.port = GuardPort.__new__(GuardPort)
        self.port.socket, self.port.fd = own, True

    def say(self, can_id, data, size=8, flags=0):
        self.other.send(struct.pack(f"=IBB2x{size}s", can_id, len(data), flags, data))

    def hear(self):
        raw = self.other.recv(100)
        can_id, length, flags = struct.unpack_from("=IBB", raw)
        return can_id, raw[8 : 8 + length], flags, len(raw)


@pytest.fixture
def wires():
    pair = Wire(), Wire()
    yield pair
    for wire in pair:
        wire.port.socket.close()
        wire.other.close()


def test_frames_pass_both_ways_as_they_are(wires):
    program, wire = wires
    guard = BusGuard(Policy(CONTENT), program.port, wire.port)
    wire.say(0x181, b"12345678")
    wire.say(0x281, bytes(range(64)), 64, 5)
    program.say(0x80, b"")
    program.say(0x601, bytes.fromhex("4064600000000000"))
    guard.step(1.0)
    assert program.hear() == (0x181, b"12345678", 0, 16)
    assert program.hear() == (0x281, bytes(range(64)), 5, 72)
    assert wire.hear() == (0x80, b"", 0, 16)
    assert wire.hear() == (0x601, bytes.fromhex("4064600000000000"), 0, 16)
    assert not guard.closed


def test_error_and_remote_frames_of_the_wire_go_nowhere(wires):
    program, wire = wires
    guard = BusGuard(Policy(CONTENT), program.port, wire.port)
    wire.say(0x181 | socket.CAN_RTR_FLAG, b"")
    wire.say(socket.CAN_ERR_FLAG | 4, bytes(8))
    wire.say(0x181 | socket.CAN_EFF_FLAG, b"7")
    guard.step(1.0)
    assert program.hear() == (0x181 | socket.CAN_EFF_FLAG, b"7", 0, 16)


def test_each_side_gets_its_turn(wires):
    program, wire = wires
    guard = BusGuard(Policy(CONTENT), program.port, wire.port)
    for _ in range(BATCH + 1):
        program.port.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
        wire.say(0x181, b"12345678")
    guard.step(1.0)
    heard = 0
    program.other.setblocking(False)
    while True:
        try:
            program.hear()
        except BlockingIOError:
            break
        heard += 1
    assert heard == BATCH == 64


def test_a_full_queue_is_tried_for_a_while(wires, monkeypatch):
    wire, times = wires[1], []
    wire.port.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    clock = iter(range(10_000))
    monkeypatch.setattr(bus_guard.time, "monotonic", lambda: next(clock) * 0.01)
    monkeypatch.setattr(bus_guard.time, "sleep", times.append)
    while wire.port.send(0x80, b""):
        assert len(times) < 10
    assert 3 <= len(times) <= 7
    wire.other.close()
    assert wire.port.send(0x80, b"") is False


def test_a_reading_that_is_cut_short_is_none():
    source = Source({"frame": 0x581, "prefix": "43646000", "at": 4, "code": "i"})
    assert source.value(bytes.fromhex("4364600001000000")) == 1
    assert source.value(bytes.fromhex("436460000100")) is None
    assert source.value(bytes.fromhex("4364600101000000")) is None
    assert Source({"frame": 1, "at": 0, "code": "b"}).value(b"") is None


def test_one_side_of_a_range_may_be_left_open_by_nobody():
    for bounds in ({"least": 0}, {"most": 0}, {"least": -math.inf, "most": 0}):
        with pytest.raises(PolicyError, match="the field needs `values`, or `least` and `most`"):
            Field({"name": "x", "at": 0, "code": "b", **bounds})
    assert Field({"name": "x", "at": 0, "code": "b", "least": 0, "most": 0}).refusal(b"\0", 0.0) == ""


def broken(change):
    content = copy.deepcopy(CONTENT)
    change(content)
    return content


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([], "TypeError"),
        ({}, "KeyError: 'schema'"),
        (
            {"schema": "armlink.guard/9", "frames": {}, "stop": []},
            "`schema` is 'armlink.guard/9', expected armlink.guard/1",
        ),
        (broken(lambda c: c["frames"]["513"].pop("lengths")), "KeyError: 'lengths'"),
        (broken(lambda c: c["frames"]["513"].update(lengths=[4])), "beyond the 4 bytes of its frame"),
        (
            broken(lambda c: c["frames"]["513"]["fields"][0].update(code="q9")),
            "number code 'q9', expected one of b, B",
        ),
        (
            broken(lambda c: c["frames"]["513"]["fields"][0].pop("most")),
            "the field needs `values`, or `least` and `most`",
        ),
        (broken(lambda c: c["frames"]["513"]["fields"][0].update(least=math.nan)), "`least` is not a number"),
        (broken(lambda c: c.update(stop=[[1, "xy"]])), "ValueError"),
        (broken(lambda c: c["frames"]["513"]["fields"][0].update(at=math.inf)), "OverflowError"),
        (broken(lambda c: c["frames"]["513"]["fields"][0].update(most=10**400)), "OverflowError"),
        (broken(lambda c: c.update(deadline=math.nan)), "policy: `deadline` is not a number"),
        (broken(lambda c: c.update(deadline="soon")), "ValueError"),
        (broken(lambda c: c["frames"]["128"].update(per_second=math.nan)), "frame: `per_second` is not a number"),
    ],
)
def test_a_wrong_policy_is_refused_in_one_line(content, said):
    with pytest.raises(PolicyError) as caught:
        Policy(content)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_it_stands_on_the_standard_library_alone():
    tree = ast.parse(Path(bus_guard.__file__).read_text())
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {name.partition(".")[0] for name in names} <= sys.stdlib_module_names


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "bus_guard.py POLICY PROGRAM_INTERFACE WIRE_INTERFACE"),
        (["missing.json", "a", "b"], "missing.json: [Errno 2]"),
        (["policy.json", "no-such-can", "can9"], ": give a CAN interface that is up"),
    ],
)
def test_wrong_arguments_get_one_line(words, said, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("policy.json").write_text(json.dumps(CONTENT))
    assert bus_guard.main(words) == 2
    error = capfd.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_the_file_alone_is_a_program():
    command = [sys.executable, "-I", bus_guard.__file__]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.strip()) == (
        2,
        "python3 -I bus_guard.py POLICY PROGRAM_INTERFACE WIRE_INTERFACE",
    )


STOP = [(0x600 + node, bytes.fromhex("2b40600002000000"), 0, 16) for node in (1, 2)]


def run_main(wires, monkeypatch, folder, steps):
    """`main` with these ports; its steps fail with these errors (None: do not), then it is told to end."""
    by_name = {"arm0": wires[0].port, "can0": wires[1].port}
    monkeypatch.setattr(bus_guard, "GuardPort", by_name.__getitem__)
    monkeypatch.setattr(bus_guard.time, "sleep", lambda seconds: None)
    step, waiting = BusGuard.step, list(steps)

    def next_step(guard, seconds):
        assert seconds <= 0.5  # a signal is looked at after each step
        if not waiting:
            signal.raise_signal(signal.SIGTERM)
            return
        failure = waiting.pop(0)
        if failure is not None:
            raise failure
        step(guard, 0.0)

    monkeypatch.setattr(BusGuard, "step", next_step)
    (folder / "policy.json").write_text(json.dumps(CONTENT))
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    try:
        return bus_guard.main([str(folder / "policy.json"), "arm0", "can0"])
    finally:
        signal.signal(signal.SIGTERM, before[0])
        signal.signal(signal.SIGINT, before[1])


def all_heard(wire):
    wire.other.setblocking(False)
    found = []
    while True:
        try:
            found.append(wire.hear())
        except BlockingIOError:
            return found


def test_main_passes_frames_until_it_is_told_to_end_and_stops_the_joints(wires, monkeypatch, tmp_path, capfd):
    program, wire = wires
    program.say(0x80, b"")
    wire.say(0x181, b"12345678")
    assert run_main(wires, monkeypatch, tmp_path, [None, InterruptedError(), None]) == 0
    assert all_heard(wire) == [(0x80, b"", 0, 16), *STOP]
    assert all_heard(program) == [(0x181, b"12345678", 0, 16)]
    first, second = capfd.readouterr().err.splitlines()
    assert first == f"guard: arm0 may command can0 as {tmp_path / 'policy.json'} allows"
    assert second.startswith("guard: closed, so it passes no more frames: the guard was ended by a signal; ")


def test_main_closes_once(wires, monkeypatch, tmp_path, capfd):
    wires[0].say(0x123, b"")
    assert run_main(wires, monkeypatch, tmp_path, [None, OSError(100, "Network is down")]) == 0
    assert all_heard(wires[1]) == STOP
    assert capfd.readouterr().err.count("closed") == 1


def test_main_closes_when_an_interface_fails_and_stays(wires, monkeypatch, tmp_path, capfd):
    failures = [OSError(100, "Network is down"), OSError(100, "Network is down")]
    wires[0].say(0x80, b"")
    assert run_main(wires, monkeypatch, tmp_path, [*failures, None]) == 0
    assert all_heard(wires[1]) == STOP
    _, line = capfd.readouterr().err.splitlines()
    assert line.startswith("guard: closed, so it passes no more frames: an interface failed (Network is down); ")


def opened(content=CONTENT):
    """A guard with this policy, its two sides and the lines that it says."""
    program, wire, lines = Side(), Side(), []
    return BusGuard(Policy(content), program, wire, lines.append), program, wire, lines


def test_a_frame_that_waited_for_longer_than_the_drives_wait_for_their_host_goes_nowhere():
    guard, _, wire, lines = opened()
    now, deadline = time.monotonic(), Policy(CONTENT).deadline
    assert deadline == 0.1
    for age in (3.0, 2.0, 1.01 * deadline):
        guard._to_wire(0x80, b"", False, now - age)
    assert wire.sent == []
    assert not guard.closed
    assert len(lines) == 1
    assert lines[0].startswith("guard: frames that are 3.0")
    guard._to_wire(0x80, b"", False, time.monotonic())
    assert wire.sent == [(0x80, b"")]


def test_a_reading_counts_from_when_it_came():
    guard, _, _, _ = opened()
    now = time.monotonic()
    for can_id, data, then in HEARD:
        guard._to_program(can_id, data, False, now - 10.0 + then - ENABLED_AT)
    guard._to_wire(0x201, COMMAND.pack(0x0F, 50, 0), False, now)
    assert "in a frame that gives power, but no reading of the joint" in guard.closed


@pytest.mark.parametrize(
    ("can_id", "data"), [(0x201, bytes(8)), (0x80, b""), (0x000, b"\1\0"), (0x601, b"\x2f\x60\x60")]
)
def test_another_host_on_the_wire_closes_it_and_is_shown_to_the_program_once(can_id, data):
    guard, program, wire, _ = opened()
    for _ in range(3):
        guard._to_program(can_id, data, False)
    assert guard.closed.startswith(f"{can_id:X}h came on the wire and is not from this guard")
    assert program.sent == [(can_id, data)]
    assert wire.sent == [(0x600 + node, bytes.fromhex("2b40600002000000")) for node in (1, 2)]


def test_requests_on_the_wire_that_only_read_stay_there():
    guard, program, _, _ = opened()
    for first in (0x40, 0x60, 0x70, 0x80):
        guard._to_program(0x601, bytes([first, 0x64, 0x60, 0, 0, 0, 0, 0]), False)
    assert not guard.closed
    assert program.sent == []


def test_two_guards_of_one_wire_pass_no_frame_around_for_ever():
    program, wire = [], []

    class Shared:
        """An interface that two guards have."""

        def __init__(self, others):
            self.others = others

        def send(self, can_id, data, fd=False):
            self.others.append((self, can_id, data))
            return True

    sides = [(Shared(program), Shared(wire)) for _ in range(2)]
    guards = [BusGuard(Policy(CONTENT), *each, lambda text: None) for each in sides]
    program.append((None, 0x80, b""))
    program.append((None, 0x601, bytes.fromhex("4064600000000000")))
    passed = 0
    while program or wire:
        passed += 1
        assert passed < 100
        if program:
            sender, *frame = program.pop(0)
            for guard, (own, _) in zip(guards, sides, strict=True):
                if own is not sender:
                    guard._to_wire(*frame, False)
        if wire:
            sender, *frame = wire.pop(0)
            for guard, (_, own) in zip(guards, sides, strict=True):
                if own is not sender:
                    guard._to_program(*frame, False)
    assert all("another host" in guard.closed for guard in guards)


def test_a_drives_frame_from_the_program_is_named_as_one():
    guard, _, _, _ = opened()
    guard._to_wire(0x181, bytes(8), False)
    assert guard.closed == (
        "the program sent identifier 181h, which only a drive may send: stop a second guard, or a "
        "program that plays a drive"
    )


def test_frames_of_the_other_kind_close_it():
    guard, _, wire, _ = opened()
    guard._to_wire(0x80, b"", True)
    assert (
        guard.closed == "the program sent 80h as CAN FD, but by the policy (`fd`) this bus carries only classical CAN"
    )
    assert (0x80, b"") not in wire.sent
    guard, _, wire, _ = opened({**CONTENT, "fd": True})
    guard._to_wire(0x80, b"", True)
    assert not guard.closed
    guard._to_wire(0x80, b"", False)
    assert (
        guard.closed == "the program sent 80h as classical CAN, but by the policy (`fd`) this bus carries only CAN FD"
    )


def test_a_policy_of_before_says_nothing_of_deadline_and_kind():
    guard, _, wire, _ = opened({key: value for key, value in CONTENT.items() if key not in ("deadline", "fd")})
    for fd in (False, True):
        guard._to_wire(0x80, b"", fd, time.monotonic() - 100.0)
    assert not guard.closed
    assert len(wire.sent) == 2


def test_syncs_that_no_cycle_needs_close_it():
    policy, now = Policy(CONTENT), ENABLED_AT
    for cycle in range(1000):
        assert policy.refusal(0x80, b"", now + PERIOD * cycle) == ""
    now += 1000 * PERIOD
    answers = [policy.refusal(0x80, b"", now + 1e-4 * number) for number in range(50)]
    assert answers[:5] == [""] * 5
    assert "80h: is sent more often than 500 times a second" in answers


@pytest.mark.parametrize(("side", "name"), [("wire", "wire"), ("program", "program")])
def test_lost_frames_close_it(wires, side, name):
    program, wire = wires
    guard = BusGuard(Policy(CONTENT), program.port, wire.port, lambda text: None)
    (wire if side == "wire" else program).port.lost = 7
    wire.say(0x181, bytes(8))
    guard.step(1.0)
    assert guard.closed == (
        f"7 frames from the {name} were lost: too many frames were sent, or this guard gets too little CPU time"
    )


def test_a_stop_that_did_not_leave_is_not_told_as_one():
    guard, _, wire, lines = opened()
    wire.full = True
    guard.close("the guard was ended by a signal")
    (line,) = lines
    assert "the stop commands could not be sent: the joints stop when their drives miss the host" in line


def test_a_program_that_takes_no_frames_keeps_none_to_the_wire_waiting(wires, monkeypatch, tmp_path):
    program = wires[0]
    program.port.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    for _ in range(40):
        wires[1].say(0x181, bytes(8))
    monkeypatch.setattr(GuardPort, "patience", math.inf)  # a wait would last for ever
    assert run_main(wires, monkeypatch, tmp_path, [None, None]) == 0
    assert 0 < len(all_heard(program)) < 40


def test_one_interface_for_both_sides_is_refused(capfd, tmp_path):
    path = tmp_path / "policy.json"
    path.write_text(json.dumps(CONTENT))
    assert bus_guard.main([str(path), "can0", "can0"]) == 2
    assert capfd.readouterr().err == (
        "guard: can0 is given as both interfaces: give first an interface for programs alone (such as a "
        "vcan), then the interface of the arm\n"
    )


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGQUIT])
def test_the_end_of_a_terminal_stops_the_joints(wires, monkeypatch, tmp_path, number):
    raise_signal = signal.raise_signal
    before = signal.getsignal(number)
    monkeypatch.setattr(signal, "raise_signal", lambda _: raise_signal(number))
    try:
        assert run_main(wires, monkeypatch, tmp_path, []) == 0
        assert signal.getsignal(signal.SIGTSTP) == signal.SIG_IGN
    finally:
        signal.signal(number, before)
        for each in (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU):
            signal.signal(each, signal.SIG_DFL)
    assert all_heard(wires[1]) == STOP


def test_nobody_there_to_read_what_it_says_is_no_error(monkeypatch):
    class Gone:
        def write(self, text):
            raise BrokenPipeError

    monkeypatch.setattr(bus_guard.sys, "stderr", Gone())
    guard = BusGuard(Policy(CONTENT), Side(), Side())
    guard.close("the guard was ended by a signal")
    assert guard.closed
