"""Registers of the simulated moteus controller, against those of mjbots' own package."""

import math
from types import SimpleNamespace

import moteus
import pytest
from moteus.protocol import scale_register

from armlink.drives.moteus.frames import SCALES, MoteusRegister
from sim_bus.drives.moteus import COMMANDS, DEFAULT_TIMEOUT, MoteusDrive


def test_a_position_command_has_the_registers_of_the_reference():
    assert set(COMMANDS) == {each.value for each in moteus.Register if 0x20 <= each <= 0x2D}


REGISTERS = sorted({*SCALES, *range(0x20, 0x2A)} - {0x01C, 0x01D})  # of these two the package knows no scale


@pytest.mark.parametrize("register", REGISTERS)
def test_a_step_of_each_register_is_that_of_the_reference(register):
    for step, resolution in zip(SCALES[register], (moteus.INT8, moteus.INT16, moteus.INT32), strict=True):
        assert 5 * step == pytest.approx(scale_register(register, resolution, 5), rel=1e-6)


@pytest.mark.parametrize(
    ("asked", "patience"), [(0.5, 0.5), (0.02, 0.02), (0.0, DEFAULT_TIMEOUT), (math.nan, DEFAULT_TIMEOUT)]
)
def test_how_long_a_command_lasts(asked, patience):
    drive = SimpleNamespace(command={MoteusRegister.COMMAND_WATCHDOG: asked})
    assert MoteusDrive.patience.fget(drive) == patience
