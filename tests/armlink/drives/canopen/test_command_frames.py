"""What the last frame orders a joint, read from its bytes as a check reads it."""

import struct
from types import SimpleNamespace

import pytest

from armlink.drives.canopen.cyclic.commands import CommandFrames
from armlink.drives.canopen.pdo import RPDO1
from armlink.drives.orders import Mode, Order, Power


def test_an_order_comes_back_from_its_bytes_at_rest_and_without_gains() -> None:
    """A drive with a position controller of its own gets no rate and no gains."""
    wire = SimpleNamespace(
        node=1,
        profile=SimpleNamespace(position_mode=int(Mode.POSITION), torque_mode=int(Mode.TORQUE)),
        limits=SimpleNamespace(lower=-3.0, upper=3.0, max_torque=50.0),
        unit=SimpleNamespace(position=1e-3, torque=0.1, velocity=1e-3),
        layouts={RPDO1.name: struct.Struct("<Hhi")},
        with_torque=True,
        by_velocity=False,
    )
    known = SimpleNamespace(names=("joint_1",), statuses=[0], mode_since=[0.0])
    cycle = CommandFrames(known, host=127, beat_every=0.1, period=0.004)
    cycle.use([wire])
    assert cycle.sent(0) is None
    cycle.frames([Order(Power.ON, False, int(Mode.POSITION), 0.5, 0.7, 3.0, 20.0, 1.0)], 0.0)
    found = cycle.sent(0)
    assert found is not None
    assert (found.power, found.walk, found.mode) == (Power.ON, False, int(Mode.POSITION))
    assert (found.position, found.torque) == pytest.approx((0.5, 3.0))
    assert (found.velocity, found.kp, found.kd) == (0.0, 0.0, 0.0)
    assert cycle.decoded(0, b"\x00") is None
