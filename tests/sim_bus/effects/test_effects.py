"""Each effect in its forward form, on a pendulum: where it shows, by how much and with which sign."""

import numpy as np
import pytest
from rig import UNIT, Rig, one_joint

from sim_bus.effects.registry import effects
from sim_bus.sim_section import EffectEntry
from sim_bus.truth import Truth

CSP, CST = 8, 10
GRAVITY = 9.81 * 0.2


def rig_with(effect: str, mode: int = CSP, **parameters: object) -> Rig:
    entries = [{"effect": "friction.coulomb", "joint": "hinge", "torque": 0.2}]
    if effect:
        entries.append({"effect": effect, "joint": "hinge", **parameters})
    rig = Rig(one_joint(effects=entries))
    rig.start(mode)
    return rig


def turn(rig: Rig, speed: float, seconds: float = 1.0) -> None:
    """Turn the joint at constant speed [rad/s] by cyclic position targets."""
    for _ in range(round(seconds / 0.004)):
        rig.position = rig.position + round(speed * 0.004 / UNIT)
        rig.cycle()


def friction(rig: Rig) -> float:
    return float((rig.arm.plant.motor_torque - rig.arm.plant.link_torque)[0])


def torque_reading(rig: Rig) -> float:
    rig.cycle()
    return float(rig.reading_torque[0] * 1e-6)


def test_the_ids_are_of_the_known_families() -> None:
    families = {effect.split(".")[0] for effect in effects()}
    assert families == {"actuator", "base", "friction", "link", "position", "timing", "torque", "transmission"}
    assert all(parameter.unit for effect in effects().values() for parameter in effect.parameters)


def test_viscous_friction_grows_with_speed() -> None:
    rig = rig_with("friction.viscous", damping=2.0)
    turn(rig, 0.3)
    assert friction(rig) == pytest.approx(0.2 + 2.0 * 0.3, abs=0.02)


def test_stribeck_friction_is_larger_at_creeping_speed() -> None:
    rig = rig_with("friction.stribeck", breakaway=0.4, velocity=0.05)
    turn(rig, 0.3)
    assert friction(rig) == pytest.approx(0.2, abs=0.01)
    turn(rig, 0.02, 2.0)
    assert friction(rig) == pytest.approx(0.2 + 0.4 * np.exp(-((0.02 / 0.05) ** 2)), abs=0.06)


def test_asymmetric_friction_differs_with_direction() -> None:
    rig = rig_with("friction.asymmetric", ratio=0.5)
    turn(rig, 0.3)
    assert friction(rig) == pytest.approx(0.3, abs=0.01)
    turn(rig, -0.3)
    assert friction(rig) == pytest.approx(-0.1, abs=0.01)


def test_load_friction_grows_with_the_transmitted_torque() -> None:
    rig = rig_with("friction.load", coefficient=0.1)
    turn(rig, 0.2, 0.5)
    assert friction(rig) == pytest.approx(0.2 + 0.1 * abs(rig.arm.plant.link_torque[0]), abs=0.01)


def test_torque_gain_offset_and_drift_change_the_reading_only() -> None:
    torque = torque_reading(rig_with(""))
    assert torque_reading(rig_with("torque.gain", gain=1.1)) == pytest.approx(1.1 * torque, abs=2e-3)
    assert torque_reading(rig_with("torque.offset", offset=0.3)) == pytest.approx(torque + 0.3, abs=2e-3)
    drifting = rig_with("torque.drift", rate=0.1)
    drifting.run(5.0)
    assert torque_reading(drifting) == pytest.approx(torque + 0.1 * drifting.arm.time, abs=5e-3)


def test_dead_band_hysteresis_and_saturation_bend_the_reading() -> None:
    torque = torque_reading(rig_with(""))
    assert torque_reading(rig_with("torque.deadband", width=0.4)) == pytest.approx(torque - 0.4, abs=2e-3)
    assert torque_reading(rig_with("torque.saturation", limit=1.0)) == pytest.approx(1.0, abs=2e-3)
    assert torque_reading(rig_with("torque.hysteresis", width=0.3)) == pytest.approx(torque - 0.3, abs=2e-3)


def test_crosstalk_mixes_the_torque_of_another_joint_in() -> None:
    rig = Rig("sarcos")
    rig.arm.set_effects([EffectEntry(effect="torque.crosstalk", joint="joint_7", coefficient=0.05, source="joint_2")])
    rig.arm.sensors.noise[:] = 0.0
    torque = rig.arm.plant.link_torque
    reading = rig.arm.sensors.torque(torque, 0.0)
    assert reading[6] == pytest.approx(torque[6] + 0.05 * torque[1], abs=0.08)  # noise of the block drawn before


def test_position_gain_offset_and_eccentricity_are_in_the_reading() -> None:
    rig = Rig(
        one_joint(
            effects=[
                {"effect": "position.offset", "joint": "hinge", "offset": 0.1},
                {"effect": "position.gain", "joint": "hinge", "gain": 1.02},
                {"effect": "position.eccentricity", "joint": "hinge", "amplitude": 0.01, "phase": 0.5},
            ]
        )
    )
    rig.start(CSP)
    rig.cycle()
    reading = rig.reading_position[0] * UNIT
    angle = 1.02 * reading + 0.1 + 0.01 * np.sin(reading + 0.5)
    assert angle == pytest.approx(rig.arm.plant.position[0], abs=1e-4)


def test_a_late_torque_sensor_shows_an_earlier_torque() -> None:
    rig = rig_with("timing.delay", delay=0.02, mode=CST)
    rig.run(0.1)
    readings, torques = [], []
    for step in range(40):
        torques.append(rig.arm.plant.link_torque[0])
        rig.cycle([round(196 + 100 * np.sin(step / 4))])
        readings.append(rig.reading_torque[0] * 1e-6)
    np.testing.assert_allclose(readings[10:], torques[5:-5], atol=5e-3)


def test_actuator_gain_makes_another_torque_than_the_drive_reports() -> None:
    rig = rig_with("actuator.gain", gain=1.2)
    rig.run(1.0)
    plant = rig.arm.plant
    np.testing.assert_allclose(plant.motor_torque, 1.2 * plant.drive_torque)
    assert plant.link_torque[0] == pytest.approx(GRAVITY, abs=0.01)


def test_actuator_saturation_clips_the_motor() -> None:
    rig = rig_with("actuator.saturation", mode=CST, limit=3.0)
    rig.cycle([900])
    rig.cycle([900])
    assert rig.arm.plant.motor_torque[0] == pytest.approx(3.0)


def test_rotor_inertia_takes_torque_on_the_motor_side_with_acceleration() -> None:
    rig = rig_with("actuator.rotor_inertia", mode=CST, inertia=0.5)
    for per_mille in (600, 600, 600, 600):
        rig.cycle([per_mille])
    plant = rig.arm.plant
    acceleration = plant.data.qacc[0]
    assert acceleration > 1.0
    assert friction(rig) == pytest.approx(0.2 + 0.5 * acceleration, abs=1e-3)


def test_actuator_delay_and_lag_make_the_torque_late() -> None:
    delayed = rig_with("actuator.delay", mode=CST, time=0.02)
    delayed.run(0.1)
    before = delayed.arm.plant.drive_torque[0]
    for _ in range(5):
        delayed.cycle([500])
        assert delayed.arm.plant.drive_torque[0] == pytest.approx(before, abs=0.02)
    delayed.cycle([500])
    assert delayed.arm.plant.drive_torque[0] == pytest.approx(5.0, abs=1e-6)
    lagging = rig_with("actuator.lag", mode=CST, time=0.02)
    lagging.run(0.1)
    before = lagging.arm.plant.drive_torque[0]
    for _ in range(5):
        lagging.cycle([500])
    share = (lagging.arm.plant.drive_torque[0] - before) / (5.0 - before)
    assert share == pytest.approx(1 - np.exp(-0.02 / 0.02), abs=0.03)


def test_ripple_is_lost_between_motor_and_sensor() -> None:
    rig = rig_with("transmission.ripple", amplitude=0.4, cycles=12.0, phase=0.3)
    turn(rig, 0.2, 0.5)
    for _ in range(30):
        turn(rig, 0.2, 0.004)
        angle = rig.arm.plant.position[0]
        assert friction(rig) == pytest.approx(0.2 + 0.4 * np.sin(12 * angle + 0.3), abs=0.01)


def test_spring_shows_in_the_sensor_too() -> None:
    rig = rig_with("transmission.spring", stiffness=3.0, rest=-0.5)
    rig.run(0.5)
    angle = rig.arm.plant.position[0]
    assert torque_reading(rig) == pytest.approx(GRAVITY * np.cos(angle) + 3.0 * (angle + 0.5), abs=0.01)


def test_effects_and_drifts_change_while_the_arm_runs() -> None:
    rig = rig_with("")
    torque = torque_reading(rig)
    rig.arm.drift("hinge", 1.03, 0.3)
    assert torque_reading(rig) == pytest.approx(1.03 * torque + 0.3, abs=3e-3)
    assert rig.arm.true_sensors.gain[0] == pytest.approx(1.03)
    rig.arm.set_effects([*rig.arm.effects, EffectEntry(effect="torque.offset", joint="hinge", offset=-0.3)])
    assert torque_reading(rig) == pytest.approx(1.03 * torque, abs=3e-3)
    assert isinstance(rig.arm.true_sensors, Truth)


def test_the_sensor_saturates_at_twice_the_rated_torque_and_is_quantised() -> None:
    rig = Rig(one_joint(sensors={"noise": [0.0], "bits": 8}))
    step = 40.0 / 256
    assert rig.arm.sensors.torque(np.array([50.0]), 0.0)[0] == 20.0
    reading = rig.arm.sensors.torque(np.array([1.3]), 0.0)[0]
    assert reading == pytest.approx(1.3, abs=step / 2)
    assert reading / step == pytest.approx(round(reading / step))


def test_noise_has_the_stated_deviation() -> None:
    rig = Rig("sarcos")
    zero = np.zeros(7)
    readings = np.array([rig.arm.sensors.torque(zero, 0.0) for _ in range(4000)])
    np.testing.assert_allclose(readings.std(axis=0), 0.002 * rig.rated, rtol=0.05)
    np.testing.assert_allclose(readings.mean(axis=0), 0.0, atol=2e-4 * rig.rated.max())
