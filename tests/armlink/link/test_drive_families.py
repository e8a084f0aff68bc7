"""The link with each family's drives, on a simulated arm: walk, hold, and calibration in the host."""

import numpy as np
import pytest

from armlink.arm_file import load_arm
from armlink.drives.orders import Power
from armlink.errors import BadInput
from armlink.link.bus_watchdog import CROWD_PER_JOINT
from armlink.link.link import Link
from armlink.link.types import Calibration, Command
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

FROM_CURRENT = (
    *("six-damiao", "six-cubemars", "six-moteus", "six-odrive", "six-robstride", "six-myactuator"),
    "six-piper",
)
SHOULDER = 1


def hold(link, command, cycles):
    return [link.cycle(command) for _ in range(cycles)]


@pytest.mark.parametrize("name", [*FROM_CURRENT, "six-cia402"])
def test_enable_hold_disable(name):
    with Link(load_arm(name), LockStepBus(name)) as link:
        link.start()
        command = Command.hold(link.enable().position)
        samples = hold(link, command, 100)
        assert np.abs(samples[-1].position - command.position).max() < 2e-3
        assert all(np.isfinite(sample.torque).all() for sample in samples[5:])
        link.disable()
        states = [group.drives.power(drive) for group in link.groups for drive in range(len(group.places))]
        assert set(states) == {Power.OFF}


@pytest.mark.parametrize("name", ["six-odrive", "six-piper"])
def test_what_drives_send_by_their_own_clock_is_no_flood_to_a_slow_host(name):
    """A host that keeps 25 Hz gets eight Piper cycles in one of its own."""
    arm = load_arm(name)
    arm = arm.model_copy(update={"link": arm.require_link().model_copy(update={"rate": 25.0})})
    with Link(arm, LockStepBus(arm=SimulatedArm(arm, Truth.of(arm), 0))) as link:
        link.start()
        command = Command.hold(link.enable().position)
        hold(link, command, 10)
        before = link.stats.frames
        hold(link, command, 50)
        each = (link.stats.frames - before) / (50 * link.n)
        assert each > CROWD_PER_JOINT if name == "six-piper" else each <= CROWD_PER_JOINT
        link.disable()


@pytest.mark.sample(2)
@pytest.mark.parametrize("name", FROM_CURRENT)
def test_a_calibration_in_the_host_corrects_reading_and_command(name):
    """A drive that makes (τ_told − offset) / gain gets gain · τ + offset for τ."""
    arm, calibration = load_arm(name), Calibration(1.25, 0.5, 1)
    with Link(arm, LockStepBus(name)) as link:
        link.start()
        position = link.enable().position
        wanted = np.zeros(link.n)
        mode = Command.hold(position).mode.copy()
        mode[SHOULDER] = 10
        command = Command(mode, wanted, position)
        hold(link, command, 40)
        before = link.torque_sent[SHOULDER]
        rounding = 0.126 if name == "six-piper" else 0.02  # half a step of 8 bits, four times
        assert before == pytest.approx(0.0, abs=rounding)
        assert link.write_calibration(SHOULDER, calibration) == calibration
        assert link.read_calibration(SHOULDER) == calibration
        samples = hold(link, command, 40)
        assert link.torque_sent[SHOULDER] == pytest.approx(calibration.offset, abs=rounding)
        told = np.mean([sample.torque[SHOULDER] for sample in samples[10:]])
        assert told == pytest.approx(0.0, abs=max(rounding, 0.05))
        assert link.commander.limits[SHOULDER].max_torque == pytest.approx(
            (arm.link.joints[SHOULDER].max_torque - calibration.offset) / calibration.gain
        )


def test_a_calibration_that_cannot_be_is_not_put_into_force():
    with Link(load_arm("six-damiao"), LockStepBus("six-damiao")) as link:
        with pytest.raises(BadInput, match="gain 9"):
            link.write_calibration(SHOULDER, Calibration(9.0, 0.0, 1))
        assert link.read_calibration(SHOULDER).is_blank
