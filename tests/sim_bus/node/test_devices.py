"""Stock CiA 402 devices on a whole arm; each data sheet: tests/armlink/drives/canopen/test_data_sheets.py."""

import pytest
import yaml

from armlink.arm_file import bundled_arms, parse_arm
from armlink.errors import BadInput, BusFault
from armlink.link.link import Link
from armlink.link.types import Command
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

UNIT = 2 * 3.141592653589793 / 2**20


def arm_of(device, **keys):
    path = bundled_arms()["six-cia402"]
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["sim"]["device"] = device
    for joint in content["link"]["joints"]:
        joint["drive"] |= keys
    return parse_arm(content, path)


def simulated(arm):
    return SimulatedArm(arm, Truth.of(arm), 1)


def test_its_torque_sensor_is_an_input_that_the_arm_file_names():
    arm = arm_of(None)
    sim = simulated(arm)
    with Link(arm, LockStepBus(arm=sim)) as link:
        link.start()
        hold = Command.hold(link.enable().position)
        for _ in range(250):
            sample = link.cycle(hold)
        truth = sim.true_sensors
        torque = truth.gain * sim.plant.link_torque + truth.offset
        assert sample.torque == pytest.approx(torque, abs=0.2)


def test_units_that_nobody_tells_are_asked_for():
    arm = arm_of("epos4")
    with (
        Link(arm, LockStepBus(arm=simulated(arm))) as link,
        pytest.raises(BadInput, match=r"base \(node 1\): .* write `position_unit`"),
    ):
        link.start()


def test_nothing_is_written_to_the_serial_number_of_another_device():
    arm = arm_of("epos4", position_unit=UNIT, torque="record", calibration=None)
    sim = simulated(arm)
    with Link(arm, LockStepBus(arm=sim)) as link, pytest.raises(BusFault):
        link.start()
    assert {(node.record.active.gain, node.record.active.offset) for node in sim.nodes} == {(1.0, 0.0)}
