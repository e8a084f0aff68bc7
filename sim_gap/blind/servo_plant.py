"""Positions alone: a second plant, kept because the diagnosis replays such arms with MuJoCo's own friction, servos and
integrator, which `sim_bus` has as well: against those it would be tested on the laws that it fits.

Links get velocities at half steps from MuJoCo's accelerations at full steps (leapfrog, 0.5 ms). Friction is
elasto-plastic (Dupont, Hayward, Armstrong, Altpeter 2002): LuGre friction without drift at rest.

f = σ₀ z + σ₁ ż + d v,  ż = v (1 − α(z, v) z/z_ss),  z_ss = g(v, τ)/σ₀ in the direction of v; α is 0 in the elastic
range (|z| below 0.7 z_ss, or v and z of opposite sign), rises smoothly and is 1 in sliding.
g = (coulomb + breakaway·exp(−(v/v_s)²) + load·|τ|)·(1 ± asymmetry).
"""

from dataclasses import replace

import mujoco
import numpy as np

from gcomp.arrays import Array
from sim_bus.effects.state import Imperfections
from sim_bus.physics.transmission import DAMPING_RATIO
from sim_gap.blind.arms import compile_arm
from sim_gap.blind.motion import RATE
from sim_gap.blind.plant import JITTER_S, TrueArm, columns_at
from sim_gap.blind.scene import ServoLaw

STEP = 0.25 / RATE
"""Time step [s]: springs must be slower."""
ENCODER_NOISE = 0.2
"""Standard deviation of a recorded position before it is rounded, in counts."""
STIFFEST = 0.05
"""Stiffness of bristles, and of a gear with play, times the square of the time step over inertia, for a stable step."""


class Bristles:
    """Friction of one arm; (n,) each."""

    def __init__(self, state: Imperfections, inertia: Array, step: float) -> None:
        """`inertia` (n,): least inertia that each motor moves [kg·m²]; `step` [s]."""
        self._state, self._step = state, step
        largest = np.maximum(state.coulomb + state.breakaway, 0.05)
        self.bristle = np.minimum(largest / 2e-4, STIFFEST * inertia / step**2)
        self._bristle_damping = 0.3 * np.sqrt(self.bristle * inertia)
        self._bend = np.zeros_like(inertia)

    def force(self, v: Array, load: Array) -> Array:
        """Friction torque against the motors' velocities `v` [rad/s], `load` the torque carried."""
        state = self._state
        level = state.coulomb
        if not state.steady_friction:
            level = level + state.breakaway * np.exp(-((v / state.stribeck_velocity) ** 2))
            level = (level + state.load_friction * np.abs(load)) * (1.0 + state.asymmetry * np.sign(v))
        longest = level / self.bristle + 1e-12
        ratio = self._bend * np.sign(v) / longest
        slip = np.clip((ratio - 0.7) / (1.0 - 0.7), 0.0, 1.0)
        rate = v * (1.0 - slip * slip * (3.0 - 2.0 * slip) * np.abs(ratio))
        self._bend = np.clip(self._bend + self._step * rate, -longest, longest)
        return np.asarray(self.bristle * self._bend + self._bristle_damping * rate + state.viscous * v)


def servo_targets(law: ServoLaw, command: Array) -> Array:
    """Targets of servos under a command, at `motion.RATE` (K, n) [rad] each: late, and no faster than their slew."""
    ticks, last = np.arange(len(command)), command[0]
    late = zip(law.delay * RATE, command.T, strict=True)
    targets = np.column_stack([np.interp(ticks - delay, ticks, column) for delay, column in late])
    if np.isfinite(law.slew).any():
        for tick, wanted in enumerate(targets):
            last = targets[tick] = last + np.clip(wanted - last, -law.slew / RATE, law.slew / RATE)
    return targets


def simulate_servos(truth: TrueArm, command: Array, law: ServoLaw) -> Array:
    """Exact readings of the encoders, which are at the motors, of an arm whose servos get a command, at `motion.RATE`
    (K, n) [rad] each."""
    arm, state = truth.arm, truth.state
    rotor, soft = arm.armature + state.rotor_inertia, state.backlash > 0.0
    model = compile_arm(replace(arm, armature=np.where(soft, 0.0, rotor)))
    data = mujoco.MjData(model)
    bristles, targets = Bristles(state, np.maximum(rotor, 0.01), STEP), servo_targets(law, command)
    stiffness = STIFFEST * rotor / STEP**2
    damping, half_play = 2.0 * DAMPING_RATIO * np.sqrt(stiffness * rotor), 0.5 * state.backlash
    spring, rest = state.spring.T
    turn = np.tile(command[0] + state.position_offset, (2, 1))  # of links and motors
    speed, half, pull = np.zeros_like(turn), np.zeros_like(turn), np.zeros_like(turn)
    carried, error_sum, out = np.zeros(arm.n), np.zeros(arm.n), np.empty_like(command)
    for tick, target in enumerate(targets):
        out[tick] = turn[1] - state.position_offset
        error = target - out[tick]
        error = np.sign(error) * np.maximum(np.abs(error) - law.dead_zone, 0.0)
        error_sum += error / RATE
        asked = law.stiffness * error - law.damping * speed[1] + law.integral * error_sum
        asked = np.clip(asked, -state.actuator_saturation, state.actuator_saturation)
        for _ in range(4):
            passed = state.actuator_gain * asked - bristles.force(speed[1], carried)
            if soft.any():
                twist = turn[1] - turn[0]
                stretch = twist - np.clip(twist, -half_play, half_play)
                through = stiffness * stretch + damping * (speed[1] - speed[0])
                through = np.where(through * stretch <= 0.0, 0.0, through)  # contact never pulls
                pull[1], passed = (passed - through) / rotor, np.where(soft, through, passed)
            data.qpos[:], data.qvel[:] = turn[0], speed[0]
            data.qfrc_applied[:] = passed - spring * (turn[0] - rest)
            mujoco.mj_forward(model, data)
            pull[0] = data.qacc
            carried = passed - np.where(soft, 0.0, rotor) * pull[0]
            pull[1] = np.where(soft, pull[1], pull[0])
            half += STEP * pull
            turn += STEP * half
            speed = half + 0.5 * STEP * pull
    return out


def record_servos(
    command: Array, position: Array, hz: float, encoder_step: float, random: np.random.Generator
) -> dict[str, Array]:
    """Columns t, q, q_cmd; positions are read at uneven times, each with the command that was sent in its turn."""
    clock = np.arange(len(position)) / RATE
    t = np.arange(0.0, clock[-1] - 2.0 / hz, 1.0 / hz)
    sent = command[np.rint(t * RATE).astype(int)]
    t[1:] += np.clip(JITTER_S * random.standard_normal(len(t) - 1), -0.2 / hz, 0.2 / hz)
    q = columns_at(t, clock, position)
    counts = np.rint(q / encoder_step + ENCODER_NOISE * random.standard_normal(q.shape))
    return {"t": t, "q": counts * encoder_step, "q_cmd": sent}
