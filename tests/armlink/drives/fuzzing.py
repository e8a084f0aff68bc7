"""Frames with any identifier, length and content, most of them near to real ones, at a family's drives."""

import math

import numpy as np
from bench import Bench

from armlink.bus.port import EXTENDED, REMOTE
from armlink.drives.orders import Mode

FAMILIES = (
    *("six-damiao", "six-cubemars", "six-robstride", "six-moteus", "six-odrive", "six-myactuator", "six-piper"),
    "six-cia402",
)
"""Arms with drives of each family."""


def fuzz(name: str, count: int, seed: int) -> int:
    """Let `count` frames in between cycles; returns how many went in. Raises AssertionError."""
    bench = Bench(name)
    bench.set_up()
    bench.walk()
    rng = np.random.default_rng(seed)
    longest = 64 if bench.link.bus.fd else 8
    given = 0
    while given < count:
        known = known_frames(bench)
        for _ in range(50):
            take_in(bench, *spoilt(rng, known, longest))
            given += 1
        command_too_much(bench)
    return given


def known_frames(bench: Bench) -> list[tuple[int, bytes]]:
    """Frames of host and drives in a cycle, after a walk."""
    bench.drives.forget()
    bench.walk(seconds=0.05)
    orders = [bench.order(j, mode=Mode.TORQUE if j % 2 else Mode.POSITION, position=0.0) for j in range(6)]
    return [*bench.cycle(orders), *bench.heard]


def take_in(bench: Bench, can_id: int, data: bytes) -> None:
    """Let a frame in as the link does. Raises AssertionError."""
    reading = bench.drives.take(can_id, data, bench.arm.time)
    order = bench.drives.command_of(can_id, data)
    if can_id in bench.fast:
        bench.fast[can_id](data)
    if reading is not None:
        assert 0 <= reading.joint < 6
        values = (reading.position, reading.velocity, reading.motor_torque, reading.temperature)
        assert not any(math.isinf(value) for value in values)
    assert order is None or 0 <= order[0] < 6
    bench.drives.fault([8] * 6, bench.arm.time)
    bench.drives.alarm()


def command_too_much(bench: Bench) -> None:
    """Order a torque beyond every limit of each joint. Raises AssertionError if it would leave."""
    bench.drives.frames([bench.order(j, mode=Mode.TORQUE, torque=1e9, position=0.0) for j in range(6)], bench.arm.time)
    for joint in range(6):
        told = bench.drives.sent(joint)
        assert told is None or math.isnan(told.torque) or abs(told.torque) <= bench.limits[joint].max_torque


def spoilt(rng: np.random.Generator, known: list[tuple[int, bytes]], longest: int) -> tuple[int, bytes]:
    """A frame of any content, or one of these changed."""
    kind = rng.integers(4)
    if kind == 0 or not known:
        flags = int(rng.choice([0, 0, EXTENDED, REMOTE, EXTENDED | REMOTE]))
        number = int(rng.integers(1 << 29 if flags & EXTENDED else 1 << 11))
        return number | flags, rng.bytes(int(rng.integers(longest + 1)))
    can_id, data = known[int(rng.integers(len(known)))]
    if kind == 1:
        return can_id, rng.bytes(int(rng.integers(longest + 1)))
    changed = bytearray(data.ljust(8, b"\0"))
    for _ in range(int(rng.integers(1, 4))):
        changed[int(rng.integers(len(changed)))] = int(rng.integers(256))
    if kind == 2:
        return can_id, bytes(changed)
    return can_id ^ 1 << int(rng.integers(29)), bytes(changed[: int(rng.integers(len(changed) + 1))])
