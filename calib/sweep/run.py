"""Runs one pass of sweeps through the link and writes each reading to disk before the next is begun."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused, Stall
from armlink.loop.driver import ArmDriver
from calib.arm.kinematics import DriveLimits
from calib.arm.sweep_section import sweep_section
from calib.motion.mover import Mover, Slipped, Stalled
from calib.motion.static_reading import StaticReading
from calib.plan.collisions import check_plan
from calib.plan.plan_limits import check_bias, check_limits
from calib.plan.sweep_plan import plan_sweep
from calib.plan.types import Sweep, SweepPlan
from calib.sweep.dataset import DataWriter, Manifest, PlanLine, SweepData, load_data
from calib.sweep.scout import SCOUT, SLOWER, rough_model, run_scout
from calib.sweep.stalls import OnStall, give_up, repeat_work, resume_after, stall_line
from gcomp.arrays import Array

APPROACH = 0.03
"""Each step is approached over at least this way [rad]."""
STOP_DISTANCE = 0.02
"""Distance from a stop at which creeping begins [rad]."""
RETRIES = 3
"""How often a joint that slipped or stalled is tried again before the sweep gives up."""


Progress = Callable[[int, int, float, str], None]
"""Called after each reading with (readings done, readings in all, seconds left, what is being done)."""

BARS = "▁▂▃▄▅▆▇█"


def run_sweep(
    link: ArmDriver,
    arm: ArmFile,
    out: Path,
    *,
    reference_mass: float = 0.0,
    resume: bool = False,
    progress: Progress | None = None,
    seed: int = 0,
    on_stall: OnStall = give_up,
) -> SweepData:
    """One pass over all joints with `reference_mass` [kg] attached (0 for none), into the directory `out`.

    The link must have been enabled; the joints hold at the end. First the scout, then the plan with its bias torques,
    then the sweeps, tip to base. With `resume` it goes on after the last reading
    on disk. After a Stall that `on_stall` accepts the joints are enabled again and the interrupted reading is repeated.
    Raises BadInput, Refused if the arm cannot be swept, BusFault; every reading made is on disk.
    """
    with DataWriter(out, new_manifest(link, arm, reference_mass, on_stall), resume) as writer:
        data = load_data(out)
        mover = repeat_work(link, on_stall, lambda: Mover(link, sweep_section(arm), DriveLimits.of(arm)))
        run = _StepPass(mover, writer, progress, on_stall, list(data.readings))
        if data.plan is None:
            first = plan_sweep(arm, seed=seed, reference_mass=reference_mass)
            check_limits(arm, first)
            check_plan(arm, first)
            run.total = first.readings
            run.scout(first)
            plan = _final_plan(arm, first, run.readings, reference_mass, seed, mover.known_resolution)
            check_limits(arm, plan)
            check_plan(arm, plan)
            writer.append(PlanLine(plan=plan, resolution=tuple(mover.known_resolution.tolist())))
        else:
            plan = data.plan
            check_bias(arm, plan)
            check_limits(arm, plan)
            check_plan(arm, plan)
            mover.resolution = np.where(data.resolution > 0, data.resolution, np.inf)
        run.total = plan.readings
        run.acceleration, run.refuge = plan.travel_acceleration, np.array(plan.scout[0])
        mover.average_to(plan.standard_error)
        for sweep in plan.sweeps:
            run.sweep(sweep)
        run.rest()
    return load_data(out)


def new_manifest(link: ArmDriver, arm: ArmFile, reference_mass: float, on_stall: OnStall) -> Manifest:
    """The manifest of a pass that begins, with what the controllers hold and the drives' numbers; raises BusFault."""
    installed = repeat_work(link, on_stall, lambda: [link.read_calibration(joint) for joint in range(link.n)])
    drives = repeat_work(link, on_stall, lambda: [link.drive_serial(joint).number for joint in range(link.n)])
    return Manifest.of(arm, reference_mass, installed, drives)


def _final_plan(
    arm: ArmFile, first: SweepPlan, readings: list[StaticReading], mass: float, seed: int, resolution: Array
) -> SweepPlan:
    """The plan with bias torques, and the scout poses that were reached."""
    plan = plan_sweep(arm, rough_model(arm, readings), seed=seed, reference_mass=mass, resolution=resolution)
    reached = tuple(first.scout[reading.index] for reading in readings if reading.sweep == SCOUT)
    return plan.model_copy(update={"scout": reached})


def sparkline(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    steps = (len(BARS) - 1) / max(high - low, 1e-12)
    return "".join(BARS[round((value - low) * steps)] for value in values)


class SweepPass:
    """A pass under way, of steps or of creeps."""

    def __init__(self, mover: Mover, writer: DataWriter, progress: Progress | None, on_stall: OnStall) -> None:
        self.mover, self.writer = mover, writer
        self.progress: Progress = progress or (lambda *_: None)
        self.began = time.monotonic()
        self._on_stall = on_stall

    def bridge(self, stall: Stall, reading: str) -> None:
        """Note a stall, enable the joints again and hold them where they stand; raises it if that is not wanted."""

        def note(stall: Stall) -> None:
            self.writer.append(stall_line(stall, self.mover.seen_at, reading))

        resume_after(self.mover, self._on_stall, stall, note)


class _StepPass(SweepPass):
    def __init__(
        self,
        mover: Mover,
        writer: DataWriter,
        progress: Progress | None,
        on_stall: OnStall,
        readings: list[StaticReading],
    ) -> None:
        super().__init__(mover, writer, progress, on_stall)
        self.readings, self._at_start = readings, len(readings)
        self.total, self.acceleration = 0, 1.0
        self.refuge = mover.position.copy()

    def save(self, reading: StaticReading) -> None:
        self.writer.append(reading)
        self.readings.append(reading)
        made = len(self.readings) - self._at_start
        left = (time.monotonic() - self.began) / made * max(self.total - len(self.readings), 0)
        self.progress(len(self.readings), self.total, left, self._text(reading))

    def _text(self, reading: StaticReading) -> str:
        """Current step, with a plot of the swept joint's torque in this sweep."""
        if reading.joint is None:
            return f"{reading.sweep} {reading.index + 1}"
        curve = [each.torque[reading.joint] for each in self.readings if each.sweep == reading.sweep]
        return f"{reading.sweep} {reading.index + 1} {sparkline(curve)}"

    def rest(self) -> None:
        """Every joint under position control, holding."""
        try:
            self.mover.hold_all()
            self.mover.cycle()
        except Stall as stall:
            self.bridge(stall, "end")

    def scout(self, plan: SweepPlan) -> None:
        """Take the scout poses that are still to be taken."""
        while True:
            done = {reading.index for reading in self.readings if reading.sweep == SCOUT}
            try:
                return run_scout(self.mover, plan, done, self.save)
            except Stall as stall:
                self.bridge(stall, f"{SCOUT} {len(done) + 1}")

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
                standing, detour = False, True
                self.bridge(stall, f"{sweep.name} {index + 1}")
                continue
            except Slipped as slip:
                retries += 1
                standing, detour = False, True
                sweep, bias = self._firmer(sweep, bias, slip.joint, retries)
                continue
            except Stalled:
                retries += 1
                standing, detour = False, True
                self.acceleration *= SLOWER
                if retries > RETRIES:
                    raise
                continue
            self.save(rest.within(sweep.name, index, np.array(sweep.servo), sweep.joint, sweep.target(index)[1]))
            open_readings.pop(0)

    def _rest_others(self, sweep: Sweep, bias: Array, target: float, direction: int, *, detour: bool = False) -> None:
        """Bring the resting joints to their places, by way of a pose known to be good, and press or hold them there."""
        mover = self.mover
        if detour:
            mover.come_to_rest()
            mover.travel(self.refuge, self.acceleration)
        mover.hold_all()
        goal = np.array(sweep.rest)
        stops = np.array(sweep.stops, dtype=np.int64) * ~np.array(sweep.servo)
        for joint in np.flatnonzero(stops):
            goal[joint] = mover.before_stop(int(joint), int(stops[joint]), STOP_DISTANCE)
        goal[sweep.joint] = target - direction * APPROACH
        mover.travel(goal, self.acceleration)
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
                f"{name}: slips off its stop in sweep {sweep.name} at {bias[joint]:.1f} N·m of {limit:.1f} allowed:"
                " lessen sweep.acceleration, or hold by servo (sweep.hold: servo)"
            )
        if more[joint] == bias[joint]:
            self.acceleration *= SLOWER
            sweep = sweep.model_copy(update={"acceleration": SLOWER * sweep.acceleration})
        return sweep, more
