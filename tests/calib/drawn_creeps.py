"""Readings of creeping joints of drawn arms, without a bus: gravity by MuJoCo, friction and warming from the truth."""

from dataclasses import dataclass, replace

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from calib.fit.sweep_readings import SweepReadings
from calib.plan.types import SweepPlan
from gcomp.identify.readings import StaticReadings
from sim_bus.effects.state import Imperfections
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

QUANTUM_SHARE = 0.0013
"""Step of the torque reading as a share of rated torque: 26 mN·m of 20 N·m."""
SAMPLES = 100
"""Samples that a bin averages."""


@dataclass(frozen=True, eq=False)
class DrawnCreep:
    """Rows of an arm, and what it truly is."""

    rows: SweepReadings
    truth: Truth
    state: Imperfections
    simulated: SimulatedArm
    top: Array
    """Highest reported rise of temperature of each joint (n,) [K]."""

    @property
    def warm_gain(self) -> Array:
        """Reading per torque (n,) at the temperatures that the drives reported last; they report whole kelvins."""
        if not self.rows.by_temperature:
            return self.simulated.sensors.gain_at(self.simulated.time)
        fall, _, heating = self.state.warm_constant.T
        return self.truth.gain / (1 - fall * (self.top + 0.5) / heating)


def creep_rows(
    joint: Array, position: Array, reading: Array, velocity: Array, mass: Array, warmth: Array, sweep: Array,
    sweeps: tuple[str, ...], warmest: Array,
) -> SweepReadings:  # fmt: skip
    """Readings (R,) of a creeping joint each, in its column of the table."""
    own, nothing = np.arange(position.shape[1]) == joint[:, None], np.zeros(position.shape[1])
    readings = StaticReadings(
        position,
        np.where(own, reading[:, None], np.nan),
        np.ones(position.shape[1]),
        load=mass,
        direction=own * np.sign(velocity)[:, None],
        series=sweep,
        velocity=own * velocity[:, None],
        warmth=own * warmth[:, None],
    )
    unknown, time = np.full(position.shape, np.nan), np.arange(len(joint), dtype=float)
    return SweepReadings(
        readings, sweeps, joint, time, readings.torque, unknown, unknown, nothing, nothing, np.asarray(warmest)
    )


def pushed(rows: SweepReadings, push: Array) -> SweepReadings:
    """With a push (R,) [N·m] in each reading."""
    return replace(rows, readings=replace(rows.readings, torque=rows.readings.torque + push[:, None]))


def draw_creep(
    arm: ArmFile, plan: SweepPlan, seed: int, mass: float, order: str = "empty loaded empty", noise: float = 0.01
) -> DrawnCreep:
    """Passes over the plan in this order; noise is the scatter of a bin's mean, as a share of Coulomb friction."""
    truth = Truth.draw(arm, seed)
    simulated = SimulatedArm(arm, truth, seed)
    state = simulated.plant._imperfections
    random = np.random.default_rng([seed, 7])
    rated = arm.require_link().rated_torques
    parts: list[list[Array]] = []
    names, t = [], 0.0
    for number, load in enumerate(order.split(), start=1):
        hung = mass if load == "loaded" else 0.0
        simulated.attach_mass(hung)
        for sweep in plan.sweeps:
            names.append(f"pass {number}, {sweep.name}")
            for side in (1.0, -1.0):
                steps = np.array(sweep.steps)[:: int(side)]
                q = np.tile(np.array(sweep.rest), (len(steps), 1))
                q[:, sweep.joint] = steps
                rate = side * (sweep.speed or 0.1)
                times = t + np.abs(steps - steps[0]) / abs(rate)
                t = float(times[-1]) + 1.5
                reading = _readings(simulated, state, truth, q, sweep.joint, rate, times, rated, random, noise)
                j = np.full(len(steps), sweep.joint)
                heat = np.array([np.floor(simulated.sensors.heating(each)[sweep.joint]) for each in times])
                parts.append(
                    [j, q, reading, np.full(len(j), rate), np.full(len(j), hung), heat, np.full(len(j), len(names) - 1)]
                )
    simulated.time = t
    joint, position, reading, velocity, masses, heat, sweep_of = (
        np.concatenate(each) for each in zip(*parts, strict=True)
    )
    top = np.array([heat[joint == j].max() for j in joint])
    warmth = heat - top if np.ptp(heat) >= 1 else np.linspace(-1, 0, len(heat))
    warmest = np.array([heat[joint == j].max() if np.ptp(heat) >= 1 else np.nan for j in range(len(rated))])
    rows = creep_rows(joint.astype(int), position, reading, velocity, masses, warmth, sweep_of, tuple(names), warmest)
    return DrawnCreep(rows, truth, state, simulated, np.array([heat[joint == j].max() for j in range(len(rated))]))


def _readings(
    simulated: SimulatedArm, state: Imperfections, truth: Truth, q: Array, joint: int, rate: float, times: Array,
    rated: Array, random: np.random.Generator, noise: float,
) -> Array:  # fmt: skip
    angles = q * truth.position_gain + truth.position_offset
    gravity = simulated.gravity_torque(angles)[:, joint]
    side, own = np.sign(rate), angles[:, joint]
    amplitude, phase, by_load, _ = state.uneven[joint]
    level = state.coulomb[joint] * (1 + amplitude * np.sin(own + phase)) + by_load * np.abs(gravity)
    level = level * (1 + state.leaning[joint] * side)
    ripple, cycles, at = state.cogging[joint]
    made = gravity + side * level + (state.viscous[joint]) * rate + 0.1 * ripple * np.sin(cycles * own + at)
    gain = np.array([simulated.sensors.gain_at(t)[joint] for t in times])
    quantum = QUANTUM_SHARE * rated[joint] / np.sqrt(12 * SAMPLES)
    error = np.hypot(quantum, noise * state.coulomb[joint]) * random.standard_normal(len(q))
    reading: Array = gain * made + simulated.sensors.offset[joint] + error
    return reading


def without(arm: ArmFile, **changes: float | tuple[float, float]) -> ArmFile:
    """The arm with other ranges of its quasi-direct drives."""
    sim = arm.sim
    return arm.model_copy(
        update={"sim": sim.model_copy(update={"quasi_direct": sim.quasi_direct.model_copy(update=changes)})}
    )
