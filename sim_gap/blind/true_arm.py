"""The true arm of a blind case: all its imperfections as arrays; without effects, those of every arm."""

from dataclasses import dataclass, field

import numpy as np

from gcomp.arrays import Array, Mask
from sim_gap.blind.arms import BenchArm, perturb


@dataclass(frozen=True)
class SharedMotor:
    """A motor that turns by q_joint + coefficient·q_other: its inertia and the friction of `joint` load both."""

    joint: int
    other: int
    coefficient: float
    inertia: float
    """[kg·m²]."""


@dataclass(eq=False)
class TrueArm:
    """One arm with its imperfections. Arrays are (n,) unless noted otherwise; SI units."""

    arm: BenchArm
    """True links, rotors and gravity; its damping and frictionloss are not used (see `coulomb`, `viscous`)."""
    coulomb: Array
    viscous: Array
    breakaway: Array
    stribeck_velocity: Array
    asymmetry: Array
    """Friction is (1 + a) times as large for positive motion and (1 − a) for negative."""
    load_friction: Array
    ripple: Array
    """Amplitude [N·m], cycles [1/rad], phase [rad], (n, 3): torque lost is amplitude·sin(cycles·θ + phase)."""
    spring: Array
    """Stiffness [N·m/rad] and rest angle [rad], (n, 2)."""
    stiffness: Array
    """Of the transmission [N·m/rad]; infinite is rigid."""
    backlash: Array
    """Full width of the play [rad]."""
    motor_gain: Array
    """Torque produced per torque that the drive reports."""
    motor_lag: Array
    motor_delay: Array
    motor_limit: Array
    torque_gain: Array
    torque_offset: Array
    torque_drift: Array
    crosstalk: Array
    """Reading of i per torque of j, (n, n)."""
    hysteresis: Array
    deadband: Array
    torque_limit: Array
    torque_delay: Array
    position_gain: Array
    position_offset: Array
    eccentricity: Array
    """Amplitude and phase [rad], (n, 2)."""
    rated: Array
    """Rated torque [N·m]: noise and resolution are proportional to it."""
    torque_noise: Array
    motor_noise: Array
    encoder_bits: int
    bandwidth: Array
    """Of the position controller [rad/s]."""
    shared: list[SharedMotor] = field(default_factory=list)

    @property
    def n(self) -> int:
        return self.arm.n

    @property
    def elastic(self) -> Mask:
        """Joints with two masses (those with elasticity or backlash), (n,) of bool."""
        return np.isfinite(self.stiffness)

    @property
    def encoder_step(self) -> float:
        """Resolution of the position sensor [rad]."""
        return float(2 * np.pi / 2**self.encoder_bits)


def sound_arm(nominal: BenchArm, rated: Array, random: np.random.Generator) -> TrueArm:
    """The arm without effects: small errors of all nominal parameters, a little friction, sensor noise."""
    n = nominal.n
    zero, one, never = np.zeros(n), np.ones(n), np.full(n, np.inf)
    return TrueArm(
        arm=perturb(nominal, random),
        coulomb=nominal.frictionloss * random.uniform(0.98, 1.02, n) + random.uniform(0.01, 0.04, n),
        viscous=nominal.damping * random.uniform(0.98, 1.02, n) + random.uniform(0.0, 0.02, n),
        breakaway=zero.copy(),
        stribeck_velocity=np.full(n, 0.05),
        asymmetry=zero.copy(),
        load_friction=zero.copy(),
        ripple=np.column_stack(
            [random.uniform(0.0, 0.01, n), random.uniform(5.0, 30.0, n), random.uniform(0.0, 6.0, n)]
        ),
        spring=np.zeros((n, 2)),
        stiffness=never.copy(),
        backlash=zero.copy(),
        motor_gain=1.0 + random.uniform(-0.003, 0.003, n),
        motor_lag=np.full(n, 0.0005),
        motor_delay=zero.copy(),
        motor_limit=never.copy(),
        torque_gain=1.0 + random.uniform(-0.002, 0.002, n),
        torque_offset=random.uniform(-0.02, 0.02, n),
        torque_drift=zero.copy(),
        crosstalk=np.zeros((n, n)),
        hysteresis=zero.copy(),
        deadband=zero.copy(),
        torque_limit=2.5 * rated,
        torque_delay=zero.copy(),
        position_gain=one.copy(),
        position_offset=random.uniform(-3e-4, 3e-4, n),
        eccentricity=np.zeros((n, 2)),
        rated=rated,
        torque_noise=rated * random.uniform(0.0005, 0.003),
        motor_noise=rated * random.uniform(0.001, 0.004),
        encoder_bits=int(random.integers(18, 21)),
        bandwidth=np.full(n, 2 * np.pi * random.uniform(2.5, 4.5)),
    )


@dataclass(frozen=True)
class PlantRun:
    """One arm and the trajectory that it is to follow."""

    truth: TrueArm
    command: Array
    """Positions at `motion.RATE`, (K, n) [rad]."""
    feed_forward: Array
    """Nominal torque along the trajectory, (K, n) [N·m]."""
    inertia: Array
    """Inertia of each joint for the controller's gains (n,) [kg·m²]."""
    seed: int


@dataclass(frozen=True)
class Log:
    """Time series at `motion.RATE`, (K, n) each, before the sensors; `position` is the angle on the encoder's side."""

    position: Array
    torque: Array
    """Link side of the transmission [N·m]."""
    motor: Array
    """Torque that the drive estimates [N·m]."""
    command: Array
    angle: Array
    """Angles of the links [rad]."""
