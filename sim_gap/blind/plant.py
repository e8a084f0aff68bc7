"""Torque cases: the true arm is the physics and the sensors of `sim_bus`, under a PID controller with feed-forward.

The diagnosis never sees that plant: it has inverse dynamics and laws of its own (`sim_gap.effects`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from armlink.arm_file import ArmFile, Kinematics, LinkJoint, LinkSection
from gcomp.arrays import Array
from sim_bus.effects.registry import imperfections
from sim_bus.effects.state import Imperfections
from sim_bus.physics.plant import Plant
from sim_bus.physics.sensors import JointSensors
from sim_bus.sim_section import Sensors, SimSection
from sim_bus.truth import Truth
from sim_gap.blind.arms import BenchArm, mjcf, perturb
from sim_gap.blind.effects.drawn_effect import DrawnEffect
from sim_gap.blind.motion import RATE, RECORDED_HZ
from sim_gap.blind.scene import Scene

LATE_PHASE = 0.35
"""Bandwidth of the controller times a drive's lag and delay, at most [rad]."""
ENCODER_NOISE = 0.4
"""Standard deviation of a position reading before it is rounded, in counts."""
JITTER_S = 4e-4


@dataclass(frozen=True, eq=False)
class TrueArm:
    """One arm with its imperfections. Arrays are (n,); SI units."""

    arm: BenchArm
    """True links, rotors and gravity; without friction, which is in `state`."""
    state: Imperfections
    rated: Array
    """Rated torque [N·m]: noise and resolution are proportional to it."""
    torque_noise: float
    motor_noise: float
    """Standard deviations, as shares of rated torque."""
    encoder_bits: int
    bandwidth: float
    """Of the controller of an arm whose drives are prompt [rad/s]."""

    @property
    def encoder_step(self) -> float:
        return float(2 * np.pi / 2**self.encoder_bits)


def true_arm(
    nominal: BenchArm, rated: Array, random: np.random.Generator, effects: Sequence[DrawnEffect] = ()
) -> TrueArm:
    """The arm with its effects, small errors of all nominal parameters, a little friction and sensor noise."""
    n, arm = nominal.n, perturb(nominal, random)
    state = imperfections(nominal.names, [setting for effect in effects for setting in effect.settings])
    state.coulomb += nominal.frictionloss * random.uniform(0.98, 1.02, n) + random.uniform(0.01, 0.04, n)
    state.viscous += nominal.damping * random.uniform(0.98, 1.02, n) + random.uniform(0.0, 0.02, n)
    gain = 1.0 + random.uniform(-0.003, 0.003, n)
    state.actuator_gain = np.where(state.actuator_gain == 1.0, gain, state.actuator_gain)
    state.torque_gain *= 1.0 + random.uniform(-0.002, 0.002, n)
    state.torque_offset += random.uniform(-0.02, 0.02, n)
    state.position_offset += random.uniform(-3e-4, 3e-4, n)
    for effect in effects:
        arm = effect.links(arm)
    return TrueArm(
        arm=replace(arm, damping=np.zeros(n), frictionloss=np.zeros(n)),
        state=state,
        rated=rated,
        torque_noise=float(random.uniform(0.0005, 0.003)),
        motor_noise=float(random.uniform(0.001, 0.004)),
        encoder_bits=int(random.integers(18, 21)),
        bandwidth=2 * np.pi * float(random.uniform(2.5, 4.5)),
    )


def controller_bandwidth(truth: TrueArm) -> Array:
    """Bandwidth of each joint's controller that a late drive allows [rad/s], (n,)."""
    late = 1.8 * (truth.state.actuator_lag + truth.state.actuator_delay)
    return np.asarray(LATE_PHASE / np.maximum(late, LATE_PHASE / truth.bandwidth))


@dataclass(frozen=True)
class Log:
    """Time series at `motion.RATE`, (K, n) each, before the sensors; `position` is the exact encoder reading."""

    position: Array
    velocity: Array
    """As the controller takes it from its readings."""
    torque: Array
    """Link side of the transmission [N·m]."""
    motor: Array
    """Torque that the drive estimates [N·m]."""
    command: Array


def arm_file(truth: TrueArm, model: Path, start: Array | None = None) -> ArmFile:
    """The arm as `sim_bus` takes it, with its links in an MJCF file, at the angles `start` (n,) [rad]."""
    joints = [
        LinkJoint(name=name, node=k + 1, rated_torque=rated, max_torque=rated)
        for k, (name, rated) in enumerate(zip(truth.arm.names, truth.rated.tolist(), strict=True))
    ]
    sensors = Sensors(noise=tuple((truth.torque_noise * truth.rated).tolist()), bits=truth.encoder_bits)
    return ArmFile(
        name="bench",
        kinematics=Kinematics(model=model, gravity=tuple(truth.arm.gravity.tolist())),
        link=LinkSection(joints=tuple(joints)),
        sim=SimSection(sensors=sensors, start=None if start is None else tuple(start.tolist())),
        path=model,
    )


def joint_sensors(truth: TrueArm, seed: int = 0) -> JointSensors:
    arm = arm_file(truth, Path("arm.xml"))
    return JointSensors(arm, Truth.of(arm), truth.state, seed)


def plant_at_rest(truth: TrueArm, angle: Array, torque: Array) -> Plant:
    """The arm with its motors at `angle` (n,) [rad] while the joints carry `torque` [N·m]."""
    state = truth.state
    stretch = torque / state.elasticity + 0.5 * state.backlash * np.sign(torque)
    with TemporaryDirectory(prefix="armlink-bench-") as folder:
        model = Path(folder) / "arm.xml"
        model.write_text(mjcf(truth.arm), encoding="utf-8")
        plant = Plant(arm_file(truth, model, angle - stretch), state)
    plant.set_servo(np.zeros(plant.n), np.zeros(plant.n), np.full(plant.n, np.inf))
    return plant


def simulate(truth: TrueArm, scene: Scene, command: Array, bandwidth: Array, seed: int) -> Log:
    """The arm along a command (K, n) [rad] under a PID controller of a bandwidth (n,) [rad/s], the nominal torque fed
    forward, on quantised and noisy readings; the velocity is theirs below 40 Hz."""
    sensors, feed_forward = joint_sensors(truth), scene.feed_forward(command)
    plant = plant_at_rest(truth, sensors.angle_of(command[0]), feed_forward[0])
    step, period = truth.encoder_step, 1.0 / RATE
    speed = np.diff(command, axis=0, prepend=command[:1]) * RATE
    noise = ENCODER_NOISE * np.random.default_rng([seed, 1]).standard_normal(command.shape)
    stiffness, damping = scene.inertia * bandwidth**2, 2 * 0.9 * scene.inertia * bandwidth
    smooth = 1.0 - np.exp(-2 * np.pi * 40.0 / RATE)
    before, velocity, error_sum = command[0], np.zeros(plant.n), np.zeros(plant.n)
    log = Log(*np.empty((5, *command.shape)))
    for tick, target in enumerate(command):
        seen = np.rint(sensors.reading_of(plant.motor_position) / step + noise[tick]) * step
        velocity += smooth * ((seen - before) * RATE - velocity)
        before, error = seen, target - seen
        error_sum += error * period
        torque = feed_forward[tick] + stiffness * (error + error_sum / 1.5)
        torque += damping * (speed[tick] - velocity)
        plant.step(torque, torque, period)
        # torques are those at the start of the last step of the physics, so positions have to be
        log.position[tick] = plant.motor_position - plant.model.opt.timestep * plant.motor_velocity
        log.velocity[tick], log.torque[tick] = velocity, plant.link_torque
        log.motor[tick], log.command[tick] = plant.drive_torque, torque
    return replace(log, position=sensors.reading_of(log.position))


def record(truth: TrueArm, command: Array, log: Log, random: np.random.Generator) -> dict[str, Array]:
    """Columns of a recording at about `RECORDED_HZ`: `t` (K,); q, dq, tau, tau_motor, tau_cmd, q_cmd."""
    clock = np.arange(len(log.position)) / RATE
    sensors = joint_sensors(truth, int(random.integers(2**31)))
    t = _times(clock[-1], RECORDED_HZ, random)
    step, per_mille = truth.encoder_step, 1e-3 * truth.rated
    position = columns_at(t, clock, log.position) / step + ENCODER_NOISE * random.standard_normal((len(t), truth.arm.n))
    torque = zip(columns_at(t, clock, log.torque), t.tolist(), strict=True)
    motor = columns_at(t, clock, log.motor) + truth.motor_noise * truth.rated * random.standard_normal(position.shape)
    last = (t * RATE + 1e-9).astype(int)  # rows end before the log does
    return {
        "t": t,
        "q": np.rint(position) * step,
        "dq": columns_at(t, clock, log.velocity),
        "tau": np.array([sensors.torque(now, time) for now, time in torque]),
        "tau_motor": np.rint(motor / per_mille) * per_mille,  # a drive's estimate in per mille of rated torque
        "tau_cmd": log.command[last],
        "q_cmd": command[last],
    }


def _times(duration: float, rate: float, random: np.random.Generator) -> Array:
    """Uneven times: jitter on every row, 0.3 % late by a good part of a period, 0.1 % lost."""
    t = np.arange(0.0, duration - 2.0 / rate, 1.0 / rate)
    t[1:] += np.clip(JITTER_S * random.standard_normal(len(t) - 1), -0.4 / rate, 0.4 / rate)
    late = random.random(len(t)) < 0.003
    t[late] += random.uniform(0.1, 0.3, int(late.sum())) / rate
    kept = random.random(len(t)) >= 0.001
    kept[0] = True
    return np.asarray(np.sort(t)[kept])


def columns_at(t: Array, clock: Array, values: Array) -> Array:
    """Columns (K, n) at other times, along straight lines."""
    return np.column_stack([np.interp(t, clock, column) for column in values.T])
