"""Steps at rest: the scout, then each sweep from step to step, its resting joints pressed on stops or held.

The scout is a few servo-held poses at which every sensor is read, before anything is pressed.
"""

from collections.abc import Sequence

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused, Stall
from calib.arm.kinematics import DriveLimits, gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.motion.mover import Slipped, Stalled
from calib.motion.static_reading import StaticReading, stack
from calib.plan.collisions import Collided, Geometry, check_plan, clear_way
from calib.plan.drawing import reading_seconds
from calib.plan.plan_limits import check_bias, check_limits
from calib.plan.planned_arm import PlannedArm
from calib.plan.rough_gravity import GravityGuess, guess_gravity
from calib.plan.sweep_plan import plan_sweep
from calib.plan.types import APPROACH, SCOUT, SCOUT_ACCELERATION, SCOUT_TITLE, Sweep, SweepPlan, reading_name
from calib.sweep.sweep_pass import SweepPass
from gcomp.arrays import Array

SLOWER, SLOWEST = 0.4, 0.15
"""Factor on the acceleration after a joint did not follow, and where that ends [rad/s²]."""


def rough_model(arm: ArmFile, readings: Sequence[StaticReading]) -> GravityGuess:
    """The rough gravity model from the scout's readings among `readings`."""
    scouted = [reading for reading in readings if reading.sweep == SCOUT]
    limits, section = DriveLimits.of(arm), sweep_section(arm)
    position, torque, motor = (stack(scouted, channel) for channel in ("position", "torque", "motor_torque"))
    return guess_gravity(gcomp_arm(arm), position, torque, motor, limits.rated, section.friction)


STOP_DISTANCE = 0.02
"""Distance from a stop at which creeping begins [rad]."""
RETRIES = 3
"""How often a joint that slipped or stalled is tried again before the sweep gives up."""


class StepPass(SweepPass):
    acceleration = 1.0
    astray = False
    """Whether the arm may stand elsewhere than where the checked ways of the plan have it."""

    def planned(self, seed: int, reference_mass: float, given: SweepPlan | None) -> SweepPlan:
        """That of the data set, else a new one, with the bias torques that the scout finds."""
        self.readings, self.refuge = list(self.data.readings), self.mover.position.copy()
        self._geometry: Geometry | None = PlannedArm(self.arm).geometry
        self.astray = bool(self.readings)
        plan = self.data.plan
        if plan is None:
            first = plan_sweep(self.arm, seed=seed, reference_mass=reference_mass)
            self._check(first, None if self.astray else self.mover.command.position)
            self.expected = reading_seconds(self.arm, first)
            self._scout(first)
            resolution = self.mover.known_resolution
            plan = _final_plan(self.arm, first, self.readings, reference_mass, seed, resolution)
            self._check(plan)
            self.keep(plan)
        else:
            check_bias(self.arm, plan)
            self._check(plan)
            self.astray = True
            self.mover.resolution = np.where(self.data.resolution > 0, self.data.resolution, np.inf)
        self.expected = reading_seconds(self.arm, plan)
        self.acceleration, self.refuge = plan.travel_acceleration, np.array(plan.scout[0])
        self.mover.average_to(plan.standard_error)
        return plan

    def _check(self, plan: SweepPlan, here: Array | None = None) -> None:
        check_limits(self.arm, plan)
        check_plan(self.arm, plan, here)

    def _travel(self, ways: Sequence[Sequence[Array]], acceleration: float, place: str) -> None:
        """Travel the first of some ways by poses (n,) [rad]; where the arm is astray, the first that is clear.

        Raises Stalled; Collided where none is clear, before anything moves.
        """
        mover, way = self.mover, ways[0]
        if self.astray:
            begin = mover.command.position.copy()
            way = clear_way(self.arm, self._geometry, [[begin, *each] for each in ways], place)[1:]
        self.astray = True
        for number, pose in enumerate(way):
            if number:
                mover.hold_all()
            mover.travel(pose, acceleration)
        self.astray = False

    def _save(self, reading: StaticReading) -> None:
        self.writer.append(reading)
        self.readings.append(reading)
        joint, name = reading.joint, reading_name(reading.sweep, reading.index)
        curve = [] if joint is None else [each.torque[joint] for each in self.readings if each.sweep == reading.sweep]
        self.tell(len(self.readings), name, curve)

    def _scout(self, plan: SweepPlan) -> None:
        """Take the scout poses that are still to be taken."""
        while True:
            try:
                return self._read_scout(plan)
            except Stall as stall:
                self.bridge(stall, f"{SCOUT} {sum(reading.sweep == SCOUT for reading in self.readings) + 1}")
                self.astray = True

    def _read_scout(self, plan: SweepPlan) -> None:
        """A pose that the drives cannot reach, or the way to which is no longer clear, is left out; raises Stalled or
        Collided where too few were reached to know the arm's weight."""
        mover, done = self.mover, {reading.index for reading in self.readings if reading.sweep == SCOUT}
        everything = np.ones(mover.link.n, dtype=bool)
        acceleration, last, unreached = SCOUT_ACCELERATION, mover.position.copy(), list[Refused]()
        for index, pose in enumerate(plan.scout):
            if index in done:
                continue
            failures = list[Refused]()
            for goal in (np.array(pose), np.array(pose), last):
                try:
                    self._travel([[goal]], acceleration, f"on the way to pose {index + 1} of the {SCOUT_TITLE}")
                    break
                except Collided as collided:
                    failures.append(collided)
                except Stalled as stall:
                    failures.append(stall)
                    mover.come_to_rest()
                    acceleration = max(SLOWER * acceleration, SLOWEST)
            if len(failures) > 1:
                unreached.append(failures[0])
                self.astray = True  # the plan leads to the next pose from this one
                continue
            self._save(mover.rest(everything).within(SCOUT, index, everything))
            last = mover.position.copy()
        if len(plan.scout) - len(unreached) < 4:
            raise unreached[0]

    def sweep(self, sweep: Sweep) -> None:
        """Take the readings of one sweep that are still to be taken; a joint that slips is pressed again."""
        done = {reading.index for reading in self.readings if reading.sweep == sweep.name}
        open_readings = [index for index in range(sweep.readings) if index not in done]
        bias = np.array(sweep.bias)
        retries, standing, detour = 0, False, False
        while open_readings:
            index = open_readings[0]
            try:
                if not standing:
                    self._rest_others(sweep, bias, *sweep.target(index), detour=detour)
                    standing = True
                rest = self._step(sweep, *sweep.target(index))
            except Stall as stall:
                self.bridge(stall, f"{sweep.name} {index + 1}")
            except Slipped as slip:
                retries += 1
                sweep, bias = self._firmer(sweep, bias, slip.joint, retries)
            except Stalled:
                retries += 1
                self.acceleration *= SLOWER
                if retries > RETRIES:
                    raise
            else:
                self._save(rest.within(sweep.name, index, np.array(sweep.servo), sweep.joint, sweep.target(index)[1]))
                open_readings.pop(0)
                continue
            standing, detour = False, True

    def _rest_others(self, sweep: Sweep, bias: Array, target: float, direction: int, *, detour: bool = False) -> None:
        """Bring the resting joints to their places, and press or hold them there; as a `detour`, by way of a pose known
        to be good, where that way is clear."""
        mover = self.mover
        if detour:
            mover.come_to_rest()
        mover.hold_all()
        goal = np.array(sweep.rest)
        stops = np.array(sweep.stops, dtype=np.int64) * ~np.array(sweep.servo)
        for joint in np.flatnonzero(stops):
            goal[joint] = mover.before_stop(int(joint), int(stops[joint]), STOP_DISTANCE)
        goal[sweep.joint] = target - direction * APPROACH
        ways = [[goal], [self.refuge, goal]]
        if detour:
            self.astray = True
            ways.reverse()
        self._travel(ways, self.acceleration, f"on the way from its present pose to sweep {sweep.name}")
        if stops.any():
            mover.press(stops, bias)

    def _step(self, sweep: Sweep, target: float, direction: int) -> StaticReading:
        """Bring the swept joint to a step from its side and read."""
        mover, joint = self.mover, sweep.joint
        goal = mover.command.position.copy()
        if direction * (target - goal[joint]) < APPROACH / 2:
            goal[joint] = target - direction * APPROACH
            mover.travel(goal, sweep.acceleration)
        goal[joint] = target
        mover.travel(goal, sweep.acceleration)
        counts = np.array(sweep.servo)
        counts[joint] = True
        return mover.rest(counts)

    def _firmer(self, sweep: Sweep, bias: Array, joint: int, retries: int) -> tuple[Sweep, Array]:
        """For a joint that slipped: a fifth more torque or, where it has all that it may, slower motion of the others.

        Raises Refused where that was tried often enough.
        """
        name, limit = self.mover.link.names[joint], self.mover.limits.max_torque[joint]
        more = bias.copy()
        more[joint] = np.clip(1.2 * bias[joint], -limit, limit)
        if retries > RETRIES:
            raise Refused(
                f"{name} slips off its stop in sweep {sweep.name} although it is pressed with "
                f"{bias[joint]:.1f} N·m ({limit:.1f} N·m are allowed): reduce sweep.acceleration, or hold "
                "joints by their position loops (`sweep.hold: servo`)"
            )
        if more[joint] == bias[joint]:
            self.acceleration *= SLOWER
            sweep = sweep.model_copy(update={"acceleration": SLOWER * sweep.acceleration})
        return sweep, more


def _final_plan(
    arm: ArmFile, first: SweepPlan, readings: list[StaticReading], mass: float, seed: int, resolution: Array
) -> SweepPlan:
    """The plan with bias torques, and the scout poses that were reached."""
    plan = plan_sweep(arm, rough_model(arm, readings), seed=seed, reference_mass=mass, resolution=resolution)
    reached = tuple(first.scout[reading.index] for reading in readings if reading.sweep == SCOUT)
    return plan.model_copy(update={"scout": reached})
