"""Both passes of a sweep on a realistic arm, reading by reading from the simulated arm's own physics, without motion.

Every reading is at rest: link angles follow from the plan and the sag, torques from MuJoCo's gravity and the cables,
readings from the simulated sensors, on straight ways between the steps so that hysteresis sees its history. Time
passes as in a sweep on the bus. What the fit gets is what the full simulation gives, a thousand times as fast.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from sweep_arms import SAMPLES, reading_of

from armlink.arm_file import ArmFile
from calib.dataset import Manifest, SweepData
from calib.plan.sweep_plan import plan_sweep
from calib.plan.types import APPROACH, SweepPlan
from calib.sweep.step_pass import rough_model
from sim_bus.physics.joint_torques import Cables, unevenness
from sim_bus.physics.sensors import NOISE_BLOCK
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

JITTER = 3e-4
"""Standard deviation of where a joint comes to rest [rad]."""
READING, SWEEP, WAY = 1.6, 6.0, 6
"""Seconds from one reading to the next, and more from sweep to sweep; points of the way between two poses."""


@dataclass
class RestingArm:
    """A simulated arm that is taken from rest to rest."""

    simulated: SimulatedArm
    seed: int = 0

    def __post_init__(self) -> None:
        plant, self.sensors = self.simulated.plant, self.simulated.sensors
        self.plant, self.state = plant, plant._imperfections
        self.sensors.noise = self.sensors.noise / np.sqrt(SAMPLES)
        self.sensors.torque_step = self.sensors.torque_step / np.sqrt(SAMPLES)  # the noise of a sample spreads it
        self.sensors._next = NOISE_BLOCK  # what is drawn already has the noise of one sample
        self.angle, self.time = plant.position, 0.0
        self.cables = Cables(self.state, (plant.lower + plant.upper) / 2, self.angle)
        self.random = np.random.default_rng([self.seed, 51])

    def go(self, pose: np.ndarray, pressed: np.ndarray) -> np.ndarray:
        """Take the motors to `pose` (n,) [rad]; torque (n,) that each sensor is under, `pressed` where not NaN."""
        way = np.linspace(self.angle, pose, WAY + 1)[1:]
        pull, free = np.array([self.cables.torque(angle) for angle in way]), np.isnan(pressed)
        torque = np.where(free, self.plant.gravity_torque(way) - pull, pressed)
        bent = way - self.state.compliance * torque
        torque = np.where(free, self.plant.gravity_torque(bent) - pull, pressed)
        if self.sensors._bent:
            for each in torque:
                self.sensors._bend(each)
        self.angle = np.asarray(pose, float)
        return np.asarray(torque[-1])

    def read(self, pose: np.ndarray, pressed: np.ndarray, direction: int = 0, seconds: float = READING):
        """(Position reading, torque reading, motor torque), (n,) each, after coming to `pose` as read [rad]."""
        self.time += seconds
        wanted = self.sensors.angle_of(pose + self.random.normal(0, JITTER, len(pose)))
        torque = self.go(wanted, pressed)
        sag = self.state.compliance * torque
        shown = self.sensors.position_counts(self.angle) * self.sensors.position_step
        reading = self.sensors.torque(torque, self.time)
        added = unevenness(self.state, self.angle, np.zeros_like(torque), torque, self.time)
        level = np.maximum(self.state.coulomb + added, 0.0)
        self.angle = self.angle - sag
        return shown, reading, torque + direction * level


def make_pass(arm: ArmFile, resting: RestingArm, plan: SweepPlan, mass: float) -> SweepData:
    """The readings of a plan, in its order."""
    n = len(arm.joint_names)
    noise = resting.sensors.noise * np.sqrt(SAMPLES)
    free = np.full(n, np.nan)
    if mass:
        resting.simulated.attach_mass(mass)
    readings = []

    def keep(got, sweep: str, index: int, servo, joint: int | None, direction: int) -> None:
        shown, reading, motor = got
        made = reading_of(resting.time, shown, reading, noise, motor)
        readings.append(made.within(sweep, index, np.array(servo), joint, direction))

    for index, pose in enumerate(plan.scout):
        keep(resting.read(np.array(pose), free), "scout", index, (True,) * n, None, 0)
    for sweep in plan.sweeps:
        resting.time += SWEEP
        bias = np.zeros(n) if sweep.bias is None else np.array(sweep.bias)
        stopped = np.array(sweep.stops, bool) & ~np.array(sweep.servo)
        pressed = np.where(stopped, bias, np.nan)
        for index in range(sweep.readings):
            target, direction = sweep.target(index)
            pose = np.array(sweep.rest)
            ends = np.where(np.array(sweep.stops) > 0, resting.plant.upper, resting.plant.lower)
            pose[stopped] = resting.sensors.reading_of(ends + resting.state.compliance * bias)[stopped]
            pose[sweep.joint] = target - direction * APPROACH
            resting.go(resting.sensors.angle_of(pose), pressed)
            pose[sweep.joint] = target
            got = resting.read(pose, pressed, direction)
            keep(got, sweep.name, index, sweep.servo, sweep.joint, direction)
    if mass:
        resting.simulated.detach_mass()
    steps = resting.sensors.position_step
    return SweepData(Path(f"pass-{mass:g}"), Manifest.of(arm, mass), tuple(readings), plan, steps, "0" * 64)


def plans(arm: ArmFile, truth: Truth) -> tuple[SweepPlan, SweepPlan]:
    """The plans of both passes, as the scout's readings would make them."""
    resting, mass, found = RestingArm(SimulatedArm(arm, truth)), 0.0, []
    for _ in range(2):
        first = plan_sweep(arm, reference_mass=mass)
        scouted = make_pass(arm, resting, first.model_copy(update={"sweeps": first.sweeps[:1]}), mass)
        kept = tuple(reading for reading in scouted.readings if reading.joint is None)
        found.append(plan_sweep(arm, rough_model(arm, kept), reference_mass=mass))
        mass = found[0].reference_mass
    return found[0], found[1]


def both_passes(
    arm: ArmFile, truth: Truth, planned: tuple[SweepPlan, SweepPlan], seed: int
) -> tuple[Truth, list[SweepData], RestingArm]:
    """(The sensors as they are at the end, both data sets, the arm)."""
    simulated = SimulatedArm(arm, truth, seed)
    resting = RestingArm(simulated, seed)
    data = [make_pass(arm, resting, planned[0], 0.0)]
    resting.time += 60.0  # the operator attaches the mass
    data.append(make_pass(arm, resting, planned[1], planned[0].reference_mass))
    simulated.time = resting.time
    return simulated.true_sensors, data, resting
