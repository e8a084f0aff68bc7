"""False readings: what is told of position, velocity and torque is believed of none alone, in every family."""

import math
import sys
from pathlib import Path

import pytest
import yaml

from armlink.arm_file import bundled_arms, load_arm, parse_arm
from armlink.drives.orders import Power
from armlink.errors import BusFault, Refused
from armlink.link.link import Link
from armlink.link.types import Command
from sim_bus.bus.fault_kinds import Fault
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.drives.drive_faults import FALSE_READINGS
from sim_bus.drives.simulated_drive import SimulatedDrive
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

sys.path.insert(0, str(Path(__file__).parents[1] / "campaigns"))

import false_readings

DRAWS, FIRST, SAMPLE = 100, 52_000, 2
CASES = [(name, seed) for seed in range(FIRST, FIRST + DRAWS) for name in false_readings.ALL]
FAMILIES = false_readings.ALL


@pytest.mark.sample(SAMPLE)
@pytest.mark.parametrize(("name", "seed"), CASES)
def test_a_false_reading_moves_no_joint_fast_nor_past_a_stop(name, seed):
    draw = false_readings.drawn(name, seed)
    outcome = false_readings.run(draw)
    assert outcome.held, f"{draw.words}: {outcome}"


@pytest.mark.sample(1)
@pytest.mark.parametrize(("name", "seed"), CASES)
def test_a_sound_arm_that_moves_as_fast_as_it_may_is_not_refused(name, seed):
    assert not false_readings.run(false_readings.drawn(name, seed, sound=True)).says


class Pushed:
    """One joint under torque control, accelerating, the others holding."""

    def __init__(self, name: str, joint: int = 1, push: float = 6.0) -> None:
        arm = load_arm(name)
        self.sim, self.joint, self.push = SimulatedArm(arm, Truth.of(arm)), joint, push
        self.bus = LockStepBus(arm=self.sim)
        self.link = Link(arm, self.bus)
        self.link.start()
        self.command = Command.hold(self.link.enable().position)
        for _ in range(150):
            self.link.cycle(self.command)

    def hold(self, cycles: int) -> None:
        for _ in range(cycles):
            self.link.commander.command(self.command)

    def until_refused(self, cycles: int = 300) -> tuple[float, str]:
        """Greatest true speed of the joint [rad/s], and what the host said."""
        sim, joint, fastest = self.sim, self.joint, 0.0
        self.command.mode[joint] = 10
        for _ in range(cycles):
            gravity = sim.gravity_torque(sim.plant.position[None])[0, joint]
            inertia = sim.plant.inertia(sim.plant.position)[joint, joint]
            self.command.torque[joint] = gravity + self.push * inertia
            try:
                self.link.commander.command(self.command)
            except (Refused, BusFault) as error:
                return fastest, str(error)
            fastest = max(fastest, abs(float(sim.plant.velocity[joint])))
        raise AssertionError(f"not noticed: {fastest:.1f} rad/s")


@pytest.mark.sample(2)
@pytest.mark.parametrize("name", FAMILIES)
def test_a_joint_whose_velocity_reading_stands_still_is_stopped_by_its_positions(name):
    pushed = Pushed(name)
    pushed.bus.inject(f"frozen.velocity:{pushed.sim.names[1]}")
    fastest, says = pushed.until_refused()
    assert fastest < 1.5
    assert "contradict each other" in says or "according to its positions" in says


@pytest.mark.sample(2)
@pytest.mark.parametrize("name", FAMILIES)
def test_a_joint_whose_position_reading_stands_still_is_stopped_by_its_velocity(name):
    pushed = Pushed(name)
    pushed.bus.inject(f"frozen.position:{pushed.sim.names[1]}")
    fastest, says = pushed.until_refused()
    assert fastest < 1.5
    assert "contradict each other" in says


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", ["six-damiao", "six-robstride", "six-cubemars"])
def test_torque_control_does_not_start_from_a_torque_that_the_drives_law_does_not_make(name):
    pushed = Pushed(name)
    pushed.bus.inject(f"forged.torque:{pushed.sim.names[1]}:25")
    pushed.link.commander.command(pushed.command)
    _, says = pushed.until_refused()
    assert "but its gains and its command give" in says or "two readings come in every cycle" in says


@pytest.mark.sample(2)
@pytest.mark.parametrize("name", ["six-cia402", "sarcos"])
@pytest.mark.parametrize("how", ["forged", "doubled"])
def test_velocities_that_a_second_node_sends_on_a_slow_channel_are_counted(name, how):
    """They come in a frame of their own, every fourth cycle, and the true ones come too."""
    pushed = Pushed(name, push=0.0)
    pushed.bus.inject(f"{how}.velocity:{pushed.sim.names[1]}")
    with pytest.raises(BusFault, match="more readings come than this joint sends"):
        pushed.hold(17)


def test_a_second_sender_of_positions_is_noticed_where_drives_send_by_their_own_clock():
    pushed = Pushed("six-odrive", push=0.0)
    pushed.bus.inject(f"forged.position:{pushed.sim.names[1]}:0.7")
    with pytest.raises((BusFault, Refused), match=r"contradict|according to its positions|its reading is false"):
        pushed.hold(5)


# ---- ranges


def started(name, **joint):
    path = bundled_arms()[name]
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    for key, value in joint.items():
        if key in content["link"]["joints"][1]:
            content["link"]["joints"][1][key] = value
        else:
            content["link"]["joints"][1]["drive"][key] = value
    arm = parse_arm(content, path)
    sim = SimulatedArm(load_arm(name), Truth.of(load_arm(name)))
    return Link(arm, LockStepBus(arm=sim)), sim


@pytest.mark.parametrize(
    ("register", "value", "says"),
    [
        (
            22,
            2.0,
            r"shoulder: register 22 \(VMAX\) limits the velocity readings to 2 rad/s, but the gate must "
            r"be able to read 3 rad/s: ",
        ),
        (
            23,
            20.0,
            r"shoulder: register 23 \(TMAX\) limits the torque readings to 20 N·m, but the gate must be "
            r"able to read 36 N·m: ",
        ),
    ],
)
def test_a_damiao_range_below_the_gates_limits_is_refused(register, value, says):
    link, sim = started("six-damiao")
    sim.drive_at[1].registers[register] = value
    with pytest.raises(Refused, match=says + r"write a larger range with the maker's tool and store it, or lower max_"):
        link.start()
    assert not any(drive.motor.powered for drive in sim.drive_at.values())


def test_a_position_range_that_ends_before_the_gates_window_is_refused():
    link, sim = started("six-damiao")
    window = link.values.limits(1, link.limits[1])
    sim.drive_at[1].registers[21] = max(-window.lower, window.upper) + 0.05
    with pytest.raises(
        Refused, match=r"register 21 \(PMAX\) limits the position readings to .* correct zero and direction"
    ):
        link.start()


def test_ranges_that_the_arm_file_states_are_held_to_the_gates_limits_too():
    link, _ = started("six-cubemars", velocity_range=2.5)
    with pytest.raises(Refused, match=r"shoulder: velocity_range limits the velocity readings to 2\.5 rad/s"):
        link.start()


def test_a_model_that_cannot_show_its_limits_is_refused():
    link, _ = started("six-robstride", max_torque=70.0)
    with pytest.raises(
        Refused, match="shoulder: the range of an RS03 limits the torque readings to 60 N·m, but the gate"
    ):
        link.start()


@pytest.mark.parametrize("name", sorted(set(bundled_arms()) - set(FAMILIES)))
def test_every_bundled_arm_starts_and_holds(name):
    with Link(load_arm(name), LockStepBus(name)) as link:
        link.start()
        command = Command.hold(link.enable().position)
        for _ in range(60):
            link.cycle(command)


# ---- the falsehoods themselves


@pytest.mark.parametrize("name", FAMILIES)
def test_every_falsehood_changes_what_is_told_on_every_family(name):
    """The arm hangs still; a reading that is scaled by nothing, or another's, is not what it was."""
    arm = load_arm(name)
    sim = SimulatedArm(arm, Truth.of(arm))
    bus, joint = LockStepBus(arm=sim), sim.names[1]
    with Link(arm, bus) as link:
        link.start()
        loop, off = link._loop, [Power.OFF] * link.n
        told = {"position": loop.latest_position, "velocity": loop.latest_velocity, "torque": loop.latest_motor_torque}
        for fault in FALSE_READINGS:
            how, _, quantity = fault.partition(".")
            bus.inject(fault_of(fault, joint, {"forged": 0.5, "scaled": 0.0}.get(how, math.nan)))
            came = loop.stats.frames
            for _ in range(8):
                link.commander.stand(off)
            if how == "scaled":
                drive = sim.device(1).motor.ratio if isinstance(sim.device(1), SimulatedDrive) else 1.0
                zero = arm.link.joints[1].settings.zero if quantity == "position" else 0.0
                assert told[quantity][1] == pytest.approx(-zero / drive, abs=0.02)
            elif how == "forged":
                told_at_drive = told[quantity][1]
                assert told_at_drive != 0.0
            assert loop.stats.frames > came
            bus.clear_faults()


def fault_of(fault, joint, value):
    return Fault(fault, joint, value)
