"""The leash of MIT commands: torque and sum of the law stay within the limit after rounding, whatever was asked."""

import numpy as np
import pytest

from armlink.drives.mit_drives import round_within
from armlink.drives.mit_packing import MitCommand, Ranges, grid_of, pack_steps, unpack_command
from armlink.drives.orders import Limits

GRID = grid_of(Ranges(12.5, 10.0, 28.0))
LIMITS = Limits(10.8, 100.0, 1.0, -2.5, 2.5, 0.1, 0.004)


def left(asked: MitCommand, position: float, velocity: float) -> MitCommand:
    steps = round_within(asked, GRID, LIMITS, position, velocity)
    return unpack_command(pack_steps(*steps), GRID)


def law(told: MitCommand, position: float, velocity: float) -> float:
    return told.kp * (told.position - position) + told.kd * (told.velocity - velocity) + told.torque


def test_a_torque_at_its_limit_cannot_hide_a_damping_beyond_it():
    """−12 + 2 (5 + 6.12) is within the limit; −10.8, all that the torque may be, + 22.24 is not."""
    told = left(MitCommand(0.0, 5.0, 0.0, 2.0, -12.0), 0.0, -6.12)
    assert abs(law(told, 0.0, -6.12)) <= LIMITS.max_torque
    assert told.kd > 1.0


@pytest.mark.parametrize("seed", range(3))
def test_whatever_is_asked_the_sum_stays_within_the_limit(seed):
    random = np.random.default_rng(seed)
    for _ in range(2000):
        kp = random.choice([0.0, random.uniform(0.0, 500.0)])
        asked = MitCommand(
            random.uniform(-3, 3), random.uniform(-10, 10), kp, random.uniform(0, 5), random.uniform(-30, 30)
        )
        position, velocity = random.uniform(-3, 3), random.uniform(-10, 10)
        told = left(asked, position, velocity)
        assert abs(told.torque) <= LIMITS.max_torque
        assert abs(law(told, position, velocity)) <= LIMITS.max_torque + 1e-9
