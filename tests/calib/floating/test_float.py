"""Float: the simulated arm stays where a hand leaves it, and nothing a hand does leads past what is allowed."""

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from daemon_bench import good_records
from made_records import put_on

from armlink.arm_file import ArmFile, load_arm
from armlink.link.link import Link
from armlink.link.types import Command, Sample
from calib.arm.kinematics import gcomp_arm
from calib.floating.run import FloatConfig, FloatControl, Floating, run_float
from gcomp.gravity.torque import gravity_torque
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

SEED = 3


def smooth(arm: ArmFile, effects: list | None = None) -> ArmFile:
    """The same arm without friction, which would hide what the float does."""
    section = arm.sim.model_copy(update={"effects": tuple(effects or ())})
    return arm.model_copy(update={"sim": section})


class Hand:
    """Pushes at the tip of the simulated arm while `force` is not zero; keeps the positions."""

    def __init__(self, simulated: SimulatedArm) -> None:
        self.simulated, self.force, self.t = simulated, np.zeros(3), 0.0
        self.positions: list[np.ndarray] = []
        self.script: list[tuple[float, np.ndarray]] = []

    def __call__(self, sample: Sample, torque: np.ndarray) -> None:
        self.positions.append(sample.position.copy())
        while self.script and len(self.positions) * 0.004 >= self.script[0][0]:
            self.force = self.script.pop(0)[1]
        self.simulated.plant.data.xfrc_applied[-1, :3] = self.force


def floated(arm: ArmFile, script: list[tuple[float, list[float]]], seconds: float) -> tuple[np.ndarray, Link]:
    simulated = SimulatedArm(arm, Truth.draw(arm, SEED), SEED)
    calibration, gravity = good_records(arm, simulated.true_sensors)
    hand = Hand(simulated)
    hand.script = [(t, np.array(force)) for t, force in script]
    link = Link(arm, LockStepBus(arm=simulated))
    with link:
        link.start()
        link.enable()
        put_on(link, calibration)
        run_float(link, arm, np.array(gravity.beta), calibration, seconds=seconds, on_sample=hand)
    return np.array(hand.positions), link


@pytest.mark.sample(1)
@pytest.mark.parametrize("friction", [True, False])
def test_the_arm_stays_where_a_hand_leaves_it(friction: bool) -> None:
    arm = load_arm("sarcos")
    if not friction:
        arm = smooth(arm)
    push = [8.0, 6.0, 4.0] if friction else [5.0, 4.0, 3.0]
    positions, _ = floated(arm, [(1.0, push), (1.6, [0.0, 0.0, 0.0])], 6.0)
    at = {t: positions[round(t / 0.004) - 1] for t in (0.9, 1.6, 3.5, 6.0)}
    assert np.abs(at[1.6] - at[0.9]).max() > 0.02  # a hand moves it
    assert np.abs(at[6.0] - at[3.5]).max() < 0.01  # and it stays


def test_it_does_not_sag_when_it_begins() -> None:
    positions, _ = floated(smooth(load_arm("sarcos")), [], 2.0)
    assert np.abs(positions - positions[0]).max() < 0.02


def test_a_hard_push_ends_softly_within_the_stops() -> None:
    """A steady push into the stops: the arm slows down, no limit is exceeded, nothing faults."""
    arm = smooth(load_arm("sarcos"))
    positions, _ = floated(arm, [(0.5, [0.0, 0.0, 3.0])], 5.0)
    described = gcomp_arm(arm)
    assert (positions > described.lower - 0.1).all()
    assert (positions < described.upper + 0.1).all()


class Peer:
    """Another arm that follows the master by position; what pushes at it is told to the master, joint by joint."""

    def __init__(self, arm: ArmFile) -> None:
        self.simulated = SimulatedArm(arm, Truth.draw(arm, SEED + 1), SEED + 1)
        calibration, gravity = good_records(arm, self.simulated.true_sensors)
        self.described, self.beta = gcomp_arm(arm), np.array(gravity.beta)
        self.link = Link(arm, LockStepBus(arm=self.simulated))
        self.link.start()
        self.goal = self.link.enable().position.copy()
        put_on(self.link, calibration)
        self.felt = [np.zeros(self.link.n)]

    def reflect(self, master: Sample) -> np.ndarray:
        """Torque of whatever touches the peer (n,) [N·m]: the model's less the sensor's, low-passed (0.04 s)."""
        self.goal += (master.position - self.goal).clip(-0.002, 0.002)
        sample = self.link.cycle(Command.hold(self.goal))
        now = gravity_torque(self.described, self.beta, self.goal[None])[0] - sample.torque
        self.felt.append(self.felt[-1] + 0.1 * (now - self.felt[-1]))
        return self.felt[-1]

    def push(self, force: list[float]) -> None:
        self.simulated.plant.data.xfrc_applied[-1, :3] = force


@pytest.mark.sample(1)
@pytest.mark.parametrize("pushed", [True, False])
def test_a_master_arm_is_a_float_plus_a_peer(pushed: bool) -> None:
    """A push at the peer's tip moves the master, which nobody touches, the way that the push would; else it rests."""
    arm = smooth(load_arm("sarcos"))
    simulated = SimulatedArm(arm, Truth.draw(arm, SEED), SEED)
    calibration, gravity = good_records(arm, simulated.true_sensors)
    link, peer, positions = Link(arm, LockStepBus(arm=simulated)), Peer(arm), []

    def watch(sample: Sample, torque: np.ndarray) -> None:
        positions.append(sample.position.copy())
        if pushed and len(positions) == 250:
            peer.push([8.0, 6.0, 4.0])

    with link, peer.link:
        link.start()
        link.enable()
        put_on(link, calibration)
        beta = np.array(gravity.beta)
        run_float(link, arm, beta, calibration, seconds=1.6, reflect=peer.reflect, on_sample=watch)
    before, after = positions[240], positions[-1]
    if not pushed:
        assert np.abs(after - before).max() < 0.03
        return
    assert np.abs(after - before).max() > 0.05
    push = np.mean(peer.felt[255:275], axis=0) - np.mean(peer.felt[200:240], axis=0)
    assert np.dot(push, after - before) > 0  # its work: the way that it pushes
    assert np.abs(peer.goal - after).max() < 0.05  # and the peer has come along


@pytest.fixture
def control() -> FloatControl:
    return made(FloatConfig())


def made(config: FloatConfig) -> FloatControl:
    arm = load_arm("sarcos")
    described = gcomp_arm(arm)
    joints = arm.require_link().joints
    rated, top = arm.require_link().rated_torques, np.array([j.max_velocity for j in joints])
    beta = np.array(good_records(arm, Truth.of(arm))[1].beta)
    return FloatControl(described, beta, rated, top, 0.004, config)


def middle() -> np.ndarray:
    described = gcomp_arm(load_arm("sarcos"))
    return np.asarray((described.lower + described.upper) / 2)


def test_at_rest_within_the_range_it_is_gravity_alone(control: FloatControl) -> None:
    q, arm = middle(), gcomp_arm(load_arm("sarcos"))
    beta = np.array(good_records(load_arm("sarcos"), Truth.of(load_arm("sarcos")))[1].beta)
    for _ in range(10):
        torque = control.torque(q)
    np.testing.assert_allclose(torque, gravity_torque(arm, beta, q[None])[0], atol=1e-9)


@pytest.mark.parametrize("side", [-1, 1])
def test_near_a_stop_it_pushes_back_and_more_so_the_nearer(side: int) -> None:
    arm = gcomp_arm(load_arm("sarcos"))
    stop = arm.upper if side > 0 else arm.lower
    gravity = made(replace(FloatConfig(), soft_share=0.0))
    pushes = []
    for distance in (0.2, 0.1, 0.05, 0.0):
        q = stop - side * distance
        pushes.append(-side * (made(FloatConfig()).torque(q) - gravity.torque(q)))
        gravity = made(replace(FloatConfig(), soft_share=0.0))
    assert np.all(pushes[0] == 0.0)
    assert np.all(np.diff(pushes, axis=0) > 0.0)


def test_damping_is_against_the_motion_and_steep_near_the_speed_limit(control: FloatControl) -> None:
    config = replace(FloatConfig(), detent_share=0.0)
    powers = []
    for speed in (0.2, 0.6, 1.0):
        law, q = made(config), middle() - 0.2
        for _ in range(40):
            q = q + 0.004 * speed
            torque = law.torque(q)
        still = made(config).torque(q)
        powers.append(still - torque)
    assert np.all(powers[0] > 0)
    assert np.all((powers[2] - powers[1]) > 3 * (powers[1] - powers[0]))


def test_a_missing_reading_counts_as_the_last(control: FloatControl) -> None:
    q = middle()
    before = control.torque(q)
    lost = q.copy()
    lost[2] = np.nan
    np.testing.assert_allclose(control.torque(lost), before)


def test_before_the_first_reading_there_is_no_torque(control: FloatControl) -> None:
    lost = middle()
    lost[0] = np.nan
    assert np.isnan(control.torque(lost)).all()


def test_a_joint_without_stops_floats_too() -> None:
    arm = load_arm("sarcos")
    described = replace(gcomp_arm(arm), lower=np.full(7, -np.inf), upper=np.full(7, np.inf))
    law = FloatControl(described, np.zeros(14), np.ones(7), np.ones(7), 0.004)
    assert np.isfinite(law.torque(np.zeros(7))).all()


def test_the_float_passes_to_the_process_that_makes_the_cycles(control: FloatControl) -> None:
    position = np.zeros(len(middle()))
    floating = pickle.loads(pickle.dumps(Floating(control, position)))
    sample = SimpleNamespace(position=position, t=0.0)
    np.testing.assert_array_equal(floating.command(sample).torque, Floating(control, position).command(sample).torque)
