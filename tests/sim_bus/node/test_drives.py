"""What a drive does: CiA 402 states, modes, limits, and the sensor on the link side."""

import itertools
import struct

import numpy as np
import pytest
from rig import UNIT, Rig, one_joint

from armlink.drives.canopen.cia402 import Control, DriveState
from sim_bus.node.cia402 import STATUS, TRANSITIONS, command, next_state
from sim_bus.truth import Truth

CSP, CST = 8, 10


def coulomb(torque: float) -> list[dict[str, object]]:
    return [{"effect": "friction.coulomb", "joint": "hinge", "torque": torque}]


@pytest.mark.parametrize(
    ("word", "asked"),
    [
        (0x00, Control.DISABLE_VOLTAGE),
        (0x02, Control.QUICK_STOP),
        (0x06, Control.SHUTDOWN),
        (0x07, Control.SWITCH_ON),
        (0x0F, Control.ENABLE),
        (0x80, Control.FAULT_RESET),
    ],
)
def test_control_words_of_the_standard(word: int, asked: Control) -> None:
    assert command(word, 0) is asked


def test_fault_reset_is_an_edge() -> None:
    assert command(0x80, 0x80) is None


def test_no_command_leads_out_of_a_fault_but_its_reset() -> None:
    for state, asked in itertools.product(DriveState, Control):
        if (state, asked) not in TRANSITIONS:
            assert next_state(state, asked) is state
    left = [asked for asked in Control if next_state(DriveState.FAULT, asked) is not DriveState.FAULT]
    assert left == [Control.FAULT_RESET]


def test_walk_through_the_states_and_back() -> None:
    rig = Rig(one_joint())
    rig.start(CSP)
    walk = [
        (0x06, DriveState.READY),
        (0x07, DriveState.SWITCHED_ON),
        (0x0F, DriveState.ENABLED),
        (0x02, DriveState.QUICK_STOP),
    ]
    walk += [(0x00, DriveState.SWITCH_ON_DISABLED), (0x0F, DriveState.SWITCH_ON_DISABLED)]
    for word, state in walk:
        rig.word = word
        rig.cycle()
        mask = 0x4F if state in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT) else 0x6F
        assert rig.status(5) & mask == STATUS[state]


def test_an_unknown_mode_is_displayed_as_none_and_holds_the_joint() -> None:
    rig = Rig(one_joint())
    rig.start(CSP)
    before = rig.arm.plant.position
    rig.select(6)  # homing
    rig.run(0.5)
    assert rig.read(5, 0x6061) == b"\0"
    np.testing.assert_allclose(rig.arm.plant.position, before, atol=1e-3)


@pytest.mark.parametrize("side", [1, -1])
def test_a_joint_pressed_on_its_stop_stays_there_and_its_sensor_reads_the_pressing_torque(side: int) -> None:
    arm = one_joint(effects=coulomb(0.2))
    rig = Rig(arm)
    rig.start(CST)
    for per_mille in np.linspace(rig.torque[0], side * 800, 500):
        rig.cycle([round(per_mille)])
    rig.run(1.0)
    plant = rig.arm.plant
    stop = plant.upper[0] if side > 0 else plant.lower[0]
    assert plant.position[0] == pytest.approx(stop, abs=2e-3)
    assert abs(plant.velocity[0]) < 1e-5
    assert plant.link_torque[0] == pytest.approx(side * 8.0, abs=0.2 + 1e-6)
    assert rig.reading_torque[0] * 1e-6 == pytest.approx(plant.link_torque[0], abs=1e-3)


def test_friction_shows_between_motor_and_sensor_with_the_sign_of_motion() -> None:
    arm = one_joint(effects=coulomb(0.5))
    rig = Rig(arm)
    rig.start(CSP)
    for direction in (1, -1):
        for _ in range(250):
            rig.position = rig.position + round(direction * 0.4 * 0.004 / UNIT)
            rig.cycle()
        plant = rig.arm.plant
        assert plant.velocity[0] == pytest.approx(direction * 0.4, rel=0.02)
        assert plant.motor_torque[0] - plant.link_torque[0] == pytest.approx(direction * 0.5, abs=1e-3)


def test_stiction_holds_a_joint_against_gravity() -> None:
    """1 kg at 0.2 m pulls with 1.96 N·m at most; friction of 2.5 N·m holds it without a motor."""
    rig = Rig(one_joint(effects=coulomb(2.5), servo={"brake": False}))
    start = rig.arm.plant.position
    rig.arm.advance(5.0)
    np.testing.assert_allclose(rig.arm.plant.position, start, atol=1e-4)
    assert rig.arm.plant.link_torque[0] == pytest.approx(9.81 * 0.2, abs=1e-3)


def test_without_brake_and_torque_the_joint_falls_on_its_lower_stop() -> None:
    rig = Rig(one_joint(effects=coulomb(0.1), servo={"brake": False}))
    rig.arm.advance(5.0)
    assert rig.arm.plant.position[0] == pytest.approx(-1.0, abs=2e-3)


@pytest.mark.parametrize("modes", [(CSP, CST), (CST, CSP), (CSP, 9), (CST, 4)])
def test_a_change_of_mode_moves_nothing(modes: tuple[int, int]) -> None:
    """Bumpless: no target of the new mode has come, so torque stays what it was and the joint where it is."""
    rig = Rig(one_joint(effects=coulomb(0.1)))
    rig.start(modes[0])
    rig.run(0.5)
    before, torque = rig.arm.plant.position, rig.arm.plant.motor_torque
    rig.select(modes[1])
    rig.arm.advance(0.4)
    np.testing.assert_allclose(rig.arm.plant.position, before, atol=1e-3)
    np.testing.assert_allclose(rig.arm.plant.motor_torque, torque, atol=0.15)


def test_enabling_releases_the_brake_without_dropping_the_load() -> None:
    for mode in (CSP, CST):
        rig = Rig(one_joint(effects=coulomb(0.05)))
        rig.start(mode)
        rig.run(0.2)
        assert abs(rig.arm.plant.position[0]) < 5e-3


def test_cyclic_position_follows_within_a_milliradian_at_rest() -> None:
    rig = Rig("sarcos")
    rig.start(CSP)
    goal = rig.position + np.array([0.2, -0.2, 0.3, -0.3, 0.4, -0.4, 0.5]) / UNIT
    start = rig.position.copy()
    for share in np.linspace(0, 1, 250):
        rig.position = np.rint(start + (goal - start) * share).astype(int)
        rig.cycle()
    rig.run(1.0)
    np.testing.assert_allclose(rig.reading_position * UNIT, goal * UNIT, atol=1e-3)


def test_a_joint_that_starts_to_move_at_constant_speed_is_on_its_way_after_sixty_milliseconds() -> None:
    rig, way = Rig(one_joint()), 0.0
    rig.start(CSP)
    rig.run(0.5)
    start = rig.position[0]
    for _ in range(16):
        way += 1.0 * 0.004
        rig.position[0] = start + round(way / UNIT)
        rig.cycle()
    assert rig.position[0] * UNIT == pytest.approx(rig.arm.plant.motor_position[0], abs=1e-3)


def torque_on_a_way(jitter: float) -> np.ndarray:
    """Torque readings [N·m] of a joint at constant speed while SYNC comes up to `jitter` [s] early or late."""
    rig, random, readings = Rig(one_joint()), np.random.default_rng(2), []
    rig.start(CSP)
    for _ in range(250):
        rig.position += round(0.4 * 0.004 / UNIT)
        rig.arm.on_frame(0x205, struct.pack("<Hhi", rig.word, 0, int(rig.position[0])))
        rig.arm.on_frame(0x80, b"")
        rig.arm.advance(0.004 + random.uniform(-jitter, jitter))
        readings += [struct.unpack("<ii", data)[1] * 1e-6 for can_id, data in rig.drain() if can_id == 0x185]
    return np.array(readings[50:])


def test_jitter_of_sync_is_neither_a_jerk_nor_a_bias() -> None:
    difference = torque_on_a_way(1e-4) - torque_on_a_way(0.0)
    assert np.abs(difference).max() < 0.1
    assert abs(difference.mean()) < 0.005


def test_targets_and_readings_of_position_share_the_sensors_gain() -> None:
    arm = one_joint()
    truth = Truth(gain=[1.0], offset=[0.0], position_gain=[1.01], position_offset=[0.1], attachment=[0, 0, 0])
    rig = Rig(arm, truth)
    rig.start(CSP)
    start = rig.position[0]
    for share in np.linspace(0, 1, 250):
        rig.position[0] = start + round(share * (0.5 / UNIT - start))
        rig.cycle()
    rig.run(2.0)
    assert rig.reading_position[0] * UNIT == pytest.approx(0.5, abs=5e-4)
    assert rig.arm.plant.position[0] == pytest.approx(1.01 * 0.5 + 0.1, abs=5e-4)


def test_the_drive_never_exceeds_its_max_torque() -> None:
    rig = Rig(one_joint())
    rig.write(5, 0x6072, 0, struct.pack("<H", 500))
    rig.start(CST)
    for _ in range(100):
        rig.cycle([1500])
        assert abs(rig.arm.plant.motor_torque[0]) <= 5.0 + 1e-9
    assert struct.unpack("<H", rig.read(5, 0x6041))[0] & 0x0800


def test_software_position_limits_bound_the_target() -> None:
    rig = Rig(one_joint())
    rig.write(5, 0x607D, 2, struct.pack("<i", round(0.3 / UNIT)))
    rig.start(CSP)
    for share in np.linspace(0, 0.8, 500):
        rig.position[0] = round(share / UNIT)
        rig.cycle()
    rig.run(1.0)
    assert rig.arm.plant.position[0] == pytest.approx(0.3, abs=1e-3)


def test_following_error_is_a_fault_where_it_is_watched() -> None:
    rig = Rig(one_joint())
    rig.write(5, 0x6065, 0, struct.pack("<I", round(0.05 / UNIT)))
    rig.start(CSP)
    rig.position[0] = round(0.9 / UNIT)
    frames = [frame for _ in range(5) for frame in rig.cycle()]
    assert (0x85, bytes.fromhex("1186210000000000")) in frames
    assert rig.status(5) & 0x4F == 0x08
    rig.word = 0x80
    assert (0x85, bytes(8)) in rig.cycle()
    assert rig.status(5) & 0x4F == 0x40


def test_profile_torque_ramps_with_its_slope() -> None:
    rig = Rig(one_joint(effects=coulomb(5.0)))
    rig.write(5, 0x6087, 0, struct.pack("<I", 1000))  # 10 N·m/s
    rig.start(4)
    rig.torque[0] = 0
    rig.run(1.0)
    rig.torque[0] = 300
    rig.run(0.2)
    assert rig.arm.plant.motor_torque[0] == pytest.approx(2.0, abs=0.05)
    rig.run(0.2)
    assert rig.arm.plant.motor_torque[0] == pytest.approx(3.0, abs=1e-6)


def test_profile_position_arrives_no_faster_than_its_velocity() -> None:
    rig = Rig(one_joint())
    rig.write(5, 0x6081, 0, struct.pack("<I", round(0.5 / UNIT)))
    rig.start(1)
    rig.position[0] = round(0.6 / UNIT)
    fastest = 0.0
    for _ in range(600):
        rig.cycle()
        fastest = max(fastest, abs(rig.arm.plant.velocity[0]))
    assert fastest == pytest.approx(0.5, rel=0.1)
    assert rig.arm.plant.position[0] == pytest.approx(0.6, abs=1e-3)


def test_cyclic_velocity_turns_the_joint_at_its_target() -> None:
    rig = Rig(one_joint())
    rig.start(9)
    rig.write(5, 0x60FF, 0, struct.pack("<i", round(0.3 / UNIT)))
    rig.run(1.0)
    assert rig.arm.plant.velocity[0] == pytest.approx(0.3, rel=0.02)
    assert struct.unpack("<i", rig.read(5, 0x606C))[0] * UNIT == pytest.approx(0.3, rel=0.05)


def test_torque_offset_adds_to_the_target_and_stays_until_overwritten() -> None:
    rig = Rig(one_joint(effects=coulomb(5.0)))
    rig.start(CST)
    rig.write(5, 0x60B2, 0, struct.pack("<h", 100))
    rig.cycle([100])
    assert rig.arm.plant.motor_torque[0] == pytest.approx(2.0, abs=1e-6)
