"""The whole chain on the simulated arm: frames travel, stops push, and only what came over the bus is fitted."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from sweep_arms import at_rate, random_arm, with_section

from armlink.arm_file import ArmFile, Tool, parse_arm
from armlink.errors import HostLate, Refused, Stall
from armlink.link.link import Link
from calib.arm.kinematics import DriveLimits
from calib.arm.sweep_section import sweep_section
from calib.dataset import SweepData, load_data
from calib.fit.gravity_fit import identify_gravity
from calib.fit.sensor_fit import SensorFit, fit_sensors
from calib.motion.mover import Mover, Slipped
from calib.sweep import step_pass as runner
from calib.sweep.run import run_sweep
from calib.sweep.verify import run_verify
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

pytestmark = pytest.mark.slow


class PowerCut(Exception):
    """What stops the first attempt."""


@dataclass
class Chain:
    arm: ArmFile
    simulated: SimulatedArm
    link: Link
    data: list[SweepData]
    fit: SensorFit
    interrupted_after: int


def enabled(simulated: SimulatedArm) -> Link:
    link = Link(simulated.arm, LockStepBus(arm=simulated))
    link.start()
    link.enable()
    return link


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    """Both passes of a three-joint arm, the first cut off in the middle of a sweep and resumed."""
    folder: Path = tmp_path_factory.mktemp("sweeps")
    arm = with_section(at_rate(random_arm(21, 3), 50.0), steps=5, acceleration=10.0, gain_std=0.002)
    simulated = SimulatedArm(arm, Truth.draw(arm, 3), 3)

    def cut(done: int, total: int, left: float, text: str) -> None:
        if done == 20:
            raise PowerCut

    link = enabled(simulated)
    with pytest.raises(PowerCut), link:
        run_sweep(link, arm, folder / "bare", progress=cut)
    interrupted_after = len(load_data(folder / "bare").readings)
    link = enabled(simulated)
    with link:
        bare = run_sweep(link, arm, folder / "bare", resume=True)
        assert bare.plan is not None
        simulated.attach_mass(bare.plan.reference_mass)
        loaded = run_sweep(link, arm, folder / "loaded", reference_mass=bare.plan.reference_mass)
        simulated.detach_mass()
        data = [bare, loaded]
        yield Chain(arm, simulated, link, data, fit_sensors(arm, data), interrupted_after)


def test_resume_goes_on_with_exactly_the_next_reading(chain: Chain) -> None:
    assert chain.interrupted_after == 20
    for data in chain.data:
        made = [(reading.sweep, reading.index) for reading in data.readings]
        assert len(made) == len(set(made))
        assert data.complete
        assert all(reading.settled for reading in data.readings)


def test_resting_joints_stand_at_their_stops(chain: Chain) -> None:
    limits, truth = DriveLimits.of(chain.arm), chain.simulated.truth
    plan = chain.data[0].plan
    assert plan is not None
    sweeps = {sweep.name: sweep for sweep in plan.sweeps}
    for reading in chain.data[0].readings:
        if reading.joint is None:
            continue
        angle, sweep = np.array(reading.position) * truth.position_gain, sweeps[reading.sweep]
        for joint, side in enumerate(sweep.stops):
            if side and not sweep.servo[joint]:
                stop = limits.upper[joint] if side > 0 else limits.lower[joint]
                assert abs(angle[joint] - stop) < 0.002


def test_sensors_and_gravity_come_out_right(chain: Chain) -> None:
    truth, fit = chain.simulated.truth, chain.fit
    rated = DriveLimits.of(chain.arm).rated
    assert np.abs(fit.value("gain") / truth.gain - 1).max() < 0.006
    assert np.all(np.abs(fit.value("offset") - truth.offset) < 0.003 * rated)
    assert np.abs(fit.value("position_gain") - truth.position_gain).max() < 0.004
    gravity = identify_gravity(chain.arm, chain.data, fit)
    limits = DriveLimits.of(chain.arm)
    poses = np.random.default_rng(0).uniform(limits.lower, limits.upper, (200, 3))
    true = chain.simulated.gravity_torque(poses)
    from calib.arm.kinematics import gcomp_arm
    from gcomp.gravity.torque import gravity_torque

    error = gravity_torque(gcomp_arm(chain.arm), gravity.beta, poses) - true
    assert np.all(np.sqrt((error**2).mean(axis=0)) < 0.006 * np.abs(true).max(axis=0))


def test_the_model_holds_at_poses_that_no_fit_has_seen(chain: Chain) -> None:
    record = chain.fit.record(chain.arm)
    gravity = identify_gravity(chain.arm, chain.data, chain.fit).record(chain.arm, record)
    check = run_verify(chain.link, chain.arm, gravity, record, poses=6, seed=1)
    assert check.passed
    assert check.sensor.shape == (6, 3)
    assert np.all(check.rms < 0.003 * DriveLimits.of(chain.arm).rated)


def test_a_pose_that_a_stall_interrupts_is_repeated(chain: Chain, monkeypatch: pytest.MonkeyPatch) -> None:
    record = chain.fit.record(chain.arm)
    gravity = identify_gravity(chain.arm, chain.data, chain.fit).record(chain.arm, record)
    rest, rests, asked = Mover.rest, [], []

    def late_once(mover: Mover, *args: object) -> object:
        rests.append(mover.position.copy())
        if len(rests) == 2:
            mover.link.stop()
            raise HostLate(0.18, 0.1)
        return rest(mover, *args)  # type: ignore[arg-type]

    def go_on(stall: Stall) -> bool:
        asked.append(str(stall))
        return True

    monkeypatch.setattr(Mover, "rest", late_once)
    check = run_verify(chain.link, chain.arm, gravity, record, poses=3, seed=1, on_stall=go_on)
    assert len(asked) == 1
    assert len(rests) == 4
    np.testing.assert_allclose(rests[1], rests[2], atol=2e-3)
    assert check.sensor.shape == (3, 3)
    assert check.passed
    rests.clear()
    with pytest.raises(HostLate, match="180 ms late"):
        run_verify(chain.link, chain.arm, gravity, record, poses=3, seed=1)
    chain.link.recover()


def test_a_travel_to_where_the_arm_stands_moves_nothing(chain: Chain) -> None:
    mover = Mover(chain.link, sweep_section(chain.arm), DriveLimits.of(chain.arm))
    mover.hold_all()
    before = mover.command.position.copy()
    mover.travel(before.copy(), 1.0)
    assert mover.command.position.tolist() == before.tolist()


def test_a_joint_that_cannot_be_held_on_its_stop_is_noticed(chain: Chain) -> None:
    """Pressed with too little torque it slips in the second after the press, and is caught."""
    mover = Mover(chain.link, sweep_section(chain.arm), DriveLimits.of(chain.arm))
    mover.hold_all()
    plan = chain.data[0].plan
    assert plan is not None
    sweep = max(plan.sweeps, key=lambda each: abs((each.bias or (0.0,))[0]))
    goal = np.array(sweep.rest)
    stops = np.array(sweep.stops, dtype=np.int64)
    for joint in np.flatnonzero(stops):
        goal[joint] = mover.before_stop(int(joint), int(stops[joint]), 0.02)
    mover.travel(goal, 1.0)

    def press_for_a_second() -> None:
        mover.press(stops, -np.array(sweep.bias))
        for _ in range(round(1.0 / chain.link.period)):
            mover.cycle()

    with pytest.raises(Slipped) as slip:
        press_for_a_second()
    assert stops[slip.value.joint] != 0
    mover.hold_all()
    mover.cycle()


def test_a_drive_that_could_push_into_the_stop_presses_no_harder_than_its_bias() -> None:
    """A light joint with a strong drive: its position loop follows into the stop, which yields by 13 mrad."""
    drive = {"name": "hinge", "node": 5, "rated_torque": 10.0, "max_torque": 10.0, "max_velocity": 1.0}
    content = {
        "name": "light",
        "kinematics": {"gravity": [0.0, -9.81, 0.0], "joints": [{"name": "hinge", "lower": -1.0, "upper": 1.0}]},
        "link": {"rate": 250, "joints": [drive]},
        "sim": {"links": [{"mass": 0.05, "com": [0.02, 0.0, 0.0], "inertia": [1e-4, 1e-4, 1e-4]}]},
    }
    arm = parse_arm(content, Path("light.yaml"))
    with enabled(SimulatedArm(arm, Truth.draw(arm, 3), 3)) as link:
        mover = Mover(link, sweep_section(arm), DriveLimits.of(arm))
        mover.hold_all()
        mover.travel(np.array([0.98]), 1.0)
        mover.press(np.array([1]), np.array([1.0]))
        pressed = [mover.cycle() for _ in range(100)][-1]
        assert pressed.motor_torque[0] == pytest.approx(1.0, abs=0.1)


def test_a_joint_that_slips_is_pressed_harder_and_at_its_limit_the_others_move_slower(chain: Chain) -> None:
    limits = DriveLimits.of(chain.arm)
    mover = Mover(chain.link, sweep_section(chain.arm), limits)
    run = runner.StepPass(chain.arm, mover, None, chain.data[0], None, lambda stall: False)
    assert chain.data[0].plan is not None
    sweep = chain.data[0].plan.sweeps[0]
    joint = int(np.flatnonzero(sweep.stops)[0])
    side, limit = sweep.stops[joint], float(limits.max_torque[joint])
    bias = side * 0.5 * limits.max_torque
    same, more = run._firmer(sweep, bias, joint, 1)
    assert same == sweep
    assert more[joint] == pytest.approx(side * 0.6 * limit)
    slower, most = run._firmer(sweep, side * limits.max_torque, joint, 1)
    assert most[joint] == side * limit
    assert slower.acceleration == pytest.approx(0.4 * sweep.acceleration)
    with pytest.raises(Refused, match="slips off its stop"):
        run._firmer(sweep, bias, joint, 4)


def test_a_stop_that_is_not_where_the_arm_file_has_it_is_named(chain: Chain) -> None:
    limits = DriveLimits.of(chain.arm)
    wrong = DriveLimits(limits.lower + 0.3, limits.upper - 0.3, limits.rated, limits.max_torque, limits.speed)
    mover = Mover(chain.link, sweep_section(chain.arm), wrong)
    mover.hold_all()
    mover.travel(np.array([(limits.lower[0] + limits.upper[0]) / 2, wrong.upper[1], 0.0]), 1.0)
    with pytest.raises(Refused, match=f"j2: no stop was found at {wrong.upper[1]:.3f} rad"):
        mover.press(np.array([0, 1, 0]), np.array([0.0, 5.0, 0.0]))
    mover.hold_all()
    mover.cycle()


def test_a_tool_mounted_after_the_sweeps_is_declared_instead_of_swept_again(chain: Chain) -> None:
    record = chain.fit.record(chain.arm)
    gravity = identify_gravity(chain.arm, chain.data, chain.fit).record(chain.arm, record)
    tool = Tool(mass=1.0, centre=tuple(chain.simulated.truth.attachment.tolist()))
    chain.simulated.attach_mass(tool.mass)
    try:
        assert not run_verify(chain.link, chain.arm, gravity, record, poses=4, seed=2).passed
        carrying = chain.arm.model_copy(update={"tool": tool})
        assert run_verify(chain.link, carrying, gravity, record, poses=4, seed=2).passed
    finally:
        chain.simulated.detach_mass()
