"""The link on the simulated arm: physics, frames and controllers as `armlink demo` uses them."""

import struct

import numpy as np
import pytest
import yaml

from armlink.arm_file import bundled_arms, load_arm, parse_arm
from armlink.errors import BusFault, Refused
from armlink.link.link import Link
from armlink.link.types import Calibration, Command
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth


@pytest.fixture
def simulated():
    arm = load_arm("sarcos")
    return SimulatedArm(arm, Truth.draw(arm, 3), 3)


@pytest.fixture
def link(simulated):
    with Link(simulated.arm, LockStepBus(arm=simulated)) as link:
        link.start()
        yield link


def run(link, command, seconds):
    return [link.cycle(command) for _ in range(round(seconds * link.rate))]


def test_enabled_joints_hold_against_gravity(link, simulated):
    sample = link.enable()
    samples = run(link, Command.hold(sample.position), 1.0)
    assert np.abs(samples[-1].position - sample.position).max() < 2e-3
    slow = [sample.motor_torque for sample in samples if np.isfinite(sample.motor_torque).all()]
    assert np.abs(np.mean(slow[-20:], axis=0)).max() > 5.0  # it carries its weight


def test_the_torque_reading_is_what_the_sensor_says(link, simulated):
    """Reading v = gain · τ + offset, with a new controller's gain 1 and offset 0: what comes is v itself."""
    sample = link.enable()
    samples = run(link, Command.hold(sample.position), 1.5)[-100:]
    truth = simulated.true_sensors
    angle = np.mean([s.position for s in samples], axis=0) * truth.position_gain + truth.position_offset
    expected = truth.gain * simulated.gravity_torque(angle[None])[0] + truth.offset
    np.testing.assert_allclose(np.mean([s.torque for s in samples], axis=0), expected, atol=0.05)


def test_a_calibration_that_is_applied_makes_the_reading_right(link, simulated):
    sample = link.enable()
    truth = simulated.true_sensors
    for joint in range(link.n):
        link.write_calibration(joint, Calibration(float(truth.gain[joint]), float(truth.offset[joint]), record_id=1))
    samples = run(link, Command.hold(sample.position), 1.5)[-100:]
    angle = np.mean([s.position for s in samples], axis=0) * truth.position_gain + truth.position_offset
    torque = np.mean([s.torque for s in samples], axis=0)
    np.testing.assert_allclose(torque, simulated.gravity_torque(angle[None])[0], atol=0.05)


def test_entering_torque_mode_does_not_drop_the_arm(link):
    sample = link.enable()
    hold = run(link, Command.hold(sample.position), 1.0)
    held = np.nanmean([s.motor_torque for s in hold[-40:]], axis=0)
    command = Command(np.full(link.n, 10, np.int8), held, np.zeros(link.n))
    samples = run(link, command, 0.1)
    assert np.abs(samples[-1].position - hold[-1].position).max() < 5e-3


def fast_arm(max_velocity):
    """The bundled arm, its last joint allowed to turn so fast [rad/s]."""
    path = bundled_arms()["sarcos"]
    content = yaml.safe_load(path.read_text())
    content["link"]["joints"][-1]["max_velocity"] = max_velocity
    return parse_arm(content, path)


def test_a_bias_torque_presses_a_joint_against_its_stop():
    arm = fast_arm(60.0)
    simulated = SimulatedArm(arm, Truth.draw(arm, 3), 3)
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        sample = link.enable()
        command = Command.hold(sample.position)
        last = link.n - 1
        command.mode[last], command.torque[last] = 10, 3.0
        samples = run(link, command, 4.0)
    upper = simulated.arm.kinematics.joints[last].upper
    angle = samples[-1].position[last] * simulated.true_sensors.position_gain[last]
    assert angle == pytest.approx(upper, abs=0.05)
    assert abs(samples[-1].position[last] - samples[-250].position[last]) < 1e-3


def test_a_joint_that_runs_away_under_a_constant_torque_is_stopped(link, simulated):
    sample = link.enable()
    command = Command.hold(sample.position)
    last = link.n - 1
    command.mode[last], command.torque[last] = 10, 3.0
    with pytest.raises(
        Refused, match=r"gate: joint_7: turns at -?[\d.]+ rad/s under torque control, the limit is [\d.]+ rad/s \("
    ):
        run(link, command, 4.0)
    simulated.advance(1.0)
    assert [node.value(0x6041, 0) & 0x6F for node in simulated.nodes] == [0x07] * link.n
    assert np.abs(simulated.plant.velocity).max() < 1e-2


def test_a_host_that_falls_silent_leaves_quick_stop(link, simulated):
    """The controllers' own deadline: nobody sends, and the joints stop and hold."""
    sample = link.enable()
    run(link, Command.hold(sample.position), 0.2)
    simulated.advance(0.5)
    with pytest.raises(BusFault, match=r"joint_\d: (emergency|quick stop active)"):
        run(link, Command.hold(sample.position), 0.1)
    simulated.advance(1.0)
    for node in simulated.nodes:
        assert node.value(0x6041, 0) & 0x6F == 0x07
    again = link.enable()
    assert np.abs(again.position - sample.position).max() < 0.02


def test_a_joint_of_a_model_file_gets_its_range_from_the_model(tmp_path):
    from armlink.link.gate_limits import joint_ranges

    (tmp_path / "arm.xml").write_text(
        '<mujoco><compiler angle="degree"/><worldbody><body><joint name="a" range="-90 45"/><geom size="1"/>'
        '<body><joint name="b" range="-10 10"/><geom size="1"/></body></body></worldbody></mujoco>'
    )
    (tmp_path / "arm.yaml").write_text(
        "name: m\nkinematics: {model: arm.xml}\nlink:\n  joints:\n"
        "    - {name: b, node: 1, rated_torque: 1.0, max_torque: 1.0}\n"
        "    - {name: a, node: 2, rated_torque: 1.0, max_torque: 1.0}\n"
    )
    ranges = joint_ranges(load_arm(tmp_path / "arm.yaml"))
    np.testing.assert_allclose(np.degrees(ranges), [[-10, 10], [-90, 45]])


@pytest.mark.sample(1)
@pytest.mark.parametrize("number", [3, 4])
def test_an_rpdo_that_another_program_has_mapped_cannot_move_a_joint(link, simulated, number):
    """A second program mapped an RPDO of its own before the link came, and sends to it while the link holds."""
    moved = simulated.nodes[6]
    cob_id = 0x100 * (number + 1) + moved.node_id
    communication, mapping = 0x1400 + number - 1, 0x1600 + number - 1
    for entry in ((mapping, 1, struct.pack("<I", 0x60400010)), (mapping, 2, struct.pack("<I", 0x607A0020))):
        moved.set_data(*entry)
    moved.set_data(mapping, 0, b"\2")
    moved.set_data(communication, 2, b"\x01")
    moved.set_data(communication, 1, struct.pack("<I", cob_id))
    link.start()
    sample = link.enable()
    run(link, Command.hold(sample.position), 0.5)
    before = simulated.plant.position[6]
    command = struct.pack("<Hi", 0x0F, int((sample.position[6] - 1.0) / (2 * np.pi) * (1 << 20)))
    for _ in range(100):
        simulated.on_frame(cob_id, command)
        link.commander.stand([0x0F] * link.n)
    assert abs(simulated.plant.position[6] - before) < 1e-3


def test_a_joint_under_position_control_that_something_else_moves_is_stopped(link, simulated):
    """Its target is changed in its controller behind the link's back: unseen by the watch of the bus."""
    command = Command.hold(link.enable().position)
    run(link, command, 0.2)
    loops = simulated.drives.loops
    last, advance = link.n - 1, loops.advance

    def driven(duration, synchronous):
        loops._position_in[last] -= round(0.02 / (2 * np.pi) * (1 << 20)) * pushes[0]
        pushes[0] += 1
        advance(duration, synchronous)

    pushes = [1]
    loops.advance = driven
    with pytest.raises(Refused, match=r"gate: joint_7: (turns at|reads) .* something else moves the joint"):
        run(link, command, 2.0)
    assert np.abs(link.latest_position - command.position).max() < 1.0
