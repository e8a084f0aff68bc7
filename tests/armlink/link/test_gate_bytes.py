"""Arbitrary callers and arbitrary nodes against the bytes that leave: no frame exceeds a limit, and it fails closed."""

import math
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from fake_joints import FAULT, FakeBus, make_arm
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from armlink.errors import ArmlinkError, Refused
from armlink.link.gate_limits import OVERSPEED
from armlink.link.link import Link
from armlink.link.types import Command

N = 2
RATED, MAX_TORQUE, RATE, SPEED, PERIOD = 40.0, 30.0, 200.0, 1.0, 0.004
TORQUE_UNIT, UNIT = RATED / 1000, 2 * math.pi / 2**20
WINDOW = 2.0 + 0.02 * 2.0 + 0.05
POSITION_STEP, TORQUE_STEP = SPEED * PERIOD, RATE * PERIOD
ENABLE = 0x0F
TORQUE_MODES, POSITION_MODES = (4, 10), (1, 8)

number = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(-40, 40), st.floats(-2.2, 2.2))
mode = st.one_of(st.sampled_from([0, 1, 4, 8, 10]), st.sampled_from([8, 10]), st.integers(-128, 127))
age = st.one_of(st.none(), st.none(), st.none(), st.sampled_from([0.0, 0.05, 0.2, -0.1, math.nan, math.inf]))
numbers = st.lists(number, min_size=N, max_size=N)
shapes = st.sampled_from(["vector"] * 12 + ["short", "long", "matrix", "scalar", "list", "text", "complex", "none"])


def shaped(values, shape, dtype):
    whole = np.array(values, dtype)
    return {
        "vector": whole,
        "short": whole[:1],
        "long": np.append(whole, whole),
        "matrix": np.stack([whole, whole]),
        "scalar": whole[0],
        "list": list(values),
        "text": np.array(["x"] * N),
        "complex": whole.astype(complex),
        "none": None,
    }[shape]


@st.composite
def commands(draw):
    modes = draw(st.lists(mode, min_size=N, max_size=N))
    if draw(st.booleans()):
        modes = [draw(st.sampled_from([8, 10]))] * N  # long runs in one mode are what is worth most
    fields = [shaped(draw(numbers), draw(shapes), float) for _ in range(2)]
    return SimpleNamespace(
        mode=shaped(modes, draw(shapes), np.int8), torque=fields[0], position=fields[1], t=draw(age), guard=None
    )


wire = st.one_of(st.integers(-(2**31), 2**31 - 1), st.integers(-400_000, 400_000))
per_mille = st.one_of(st.integers(-(2**15), 2**15 - 1), st.integers(-800, 800))
events = st.one_of(
    st.tuples(st.just("nothing")),
    st.tuples(st.just("read"), st.integers(1, N), wire, per_mille, st.one_of(st.integers(-300_000, 300_000), wire)),
    st.tuples(st.just("silent"), st.integers(1, N), st.booleans()),
    st.tuples(st.just("fault"), st.integers(1, N)),
    st.tuples(st.just("late"), st.integers(1, N), wire),
    st.tuples(st.just("reorder")),
    st.tuples(st.just("frame"), st.integers(0, 0x7FF), st.binary(max_size=8)),
    st.tuples(st.just("pause"), st.sampled_from([0.001, 0.05, 0.15])),
)
steps = st.lists(st.tuples(st.lists(events, max_size=2), commands()), min_size=1, max_size=12)


def happen(bus, event):
    kind, *rest = event
    if kind == "read":
        node = bus.nodes[rest[0]]
        node.position, node.motor, node.velocity = rest[1:]
    elif kind == "silent":
        bus.nodes[rest[0]].no_tpdo = rest[1]
    elif kind == "fault":
        bus.nodes[rest[0]].status = FAULT
        bus.out.append((0x380 + rest[0], struct.pack("<Hb", FAULT, 8)))
    elif kind == "late":
        bus.out.append((0x180 + rest[0], struct.pack("<ii", rest[1], 0)))
    elif kind == "reorder":
        bus.out.reverse()
    elif kind == "frame":
        bus.out.append(tuple(rest))
    elif kind == "pause":
        bus.clock.time += rest[0]


class Observed(FakeBus):
    """Knows what the link has been told: the newest readings that it took in, and when."""

    def __init__(self, nodes):
        super().__init__(nodes)
        self.told = {node: {"position": math.nan, "motor": math.nan, "velocity": math.nan} for node in nodes}
        self.mode = dict.fromkeys(nodes, 0)
        self.left = []  # (id, data, what was known when it left)

    def take(self, timeout=0.0):
        frame = super().take(timeout)
        if frame is not None:
            can_id, data = frame
            told = self.told.get(can_id & 0x7F)
            if told is not None and can_id & 0x780 == 0x180 and len(data) == 8:
                told["position"] = struct.unpack("<ii", data)[0] * UNIT
            if told is not None and can_id & 0x780 == 0x280 and len(data) == 8:
                _, motor, velocity = struct.unpack("<Hhi", data)
                told["motor"], told["velocity"] = motor * TORQUE_UNIT, velocity * UNIT
        return frame

    def put(self, can_id, data):
        if can_id & 0x780 == 0x300 and can_id & 0x7F in self.mode:
            self.mode[can_id & 0x7F] = struct.unpack("<b", data)[0]
        if can_id & 0x780 in (0x200, 0x300) and can_id & 0x7F in self.told:
            self.left.append((can_id, bytes(data), dict(self.told[can_id & 0x7F])))
        super().put(can_id, data)


def check(frame_mode, now, before, told):
    """One RPDO1 that enables a joint: `now` is (control, torque, position), `before` the mode and the one earlier."""
    _, torque, position = now
    old_mode, (old_control, old_torque, old_position) = before
    running = old_control & ENABLE == ENABLE
    if frame_mode in TORQUE_MODES:
        if running and old_mode in TORQUE_MODES:
            start = old_torque * TORQUE_UNIT
        else:
            start = max(-MAX_TORQUE, min(MAX_TORQUE, told["motor"]))
        assert abs(torque * TORQUE_UNIT - start) <= TORQUE_STEP + TORQUE_UNIT * (1 + 1e-6)
        assert abs(told["velocity"]) <= OVERSPEED * SPEED
        assert abs(told["position"]) <= WINDOW + 0.1
    elif frame_mode in POSITION_MODES:
        start = old_position * UNIT if running and old_mode in POSITION_MODES else told["position"]
        assert abs(position * UNIT - start) <= POSITION_STEP + UNIT * (1 + 1e-6)
        assert abs(position * UNIT) <= max(WINDOW, abs(start)) + UNIT


def judge(bus, last):
    """Every RPDO1 that left in one cycle, against every limit; `last` has each node's mode and the one before."""
    modes, seen = {node: state[0] for node, state in last.items()}, dict.fromkeys(bus.nodes, 0)
    for can_id, data, told in bus.left:
        node = can_id & 0x7F
        if can_id & 0x780 == 0x300:
            modes[node] = struct.unpack("<b", data)[0]
            continue
        now = struct.unpack("<Hhi", data)
        assert abs(now[1]) * TORQUE_UNIT <= MAX_TORQUE
        seen[node] += 1
        if now[0] & ENABLE == ENABLE:
            assert seen[node] == 1  # whatever was refused, nothing is enabled any more after this cycle
            check(modes[node], now, last[node], told)
        last[node] = (modes[node], now)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(steps)
def test_no_byte_that_leaves_exceeds_a_limit(steps):
    bus = Observed(range(1, N + 1))
    for node in bus.nodes.values():
        node.values[0x6502, 0] = struct.pack("<I", 0x289)
        node.modes = (1, 4, 8, 10)
    with Link(make_arm(N), bus) as link:
        for happening, command in steps:
            if not link._enabled:
                for node in bus.nodes.values():
                    node.__dict__.update(status=0x40, no_tpdo=False, velocity=0, position=0, motor=0)
                bus.out.clear()
                link.start()
                link.enable()
            for event in happening:
                happen(bus, event)
            last = {node: (bus.mode[node], each.control) for node, each in bus.nodes.items()}
            bus.left.clear()
            if command.t is not None:
                command.t = bus.clock.time - command.t
            try:
                link.cycle(command)
            except ArmlinkError:
                assert not link._enabled
            judge(bus, last)


def test_what_leaves_after_a_command_of_a_wrong_shape_is_a_quick_stop(enabled, bus):
    bus.sent.clear()
    bad = Command(np.full(3, 10, np.int8), np.zeros((3, 1)), np.zeros(3))
    with pytest.raises(Refused, match=r"gate: field `torque` of the command is an array of shape \(3, 1\)"):
        enabled.cycle(bad)
    words = [struct.unpack("<Hhi", data)[0] for can_id, data in bus.sent if can_id & 0x780 == 0x200]
    assert set(words) == {0x02}
