"""Runs one pass of creep sweeps through the link; each reading is on disk before the next sweep begins."""

import time
from pathlib import Path

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused, Stall
from armlink.link.guard import ReadingBounds
from armlink.loop.driver import ArmDriver
from calib.arm.kinematics import DriveLimits
from calib.arm.sweep_section import sweep_section
from calib.creep.plan import RAMP, CreepGround, check_creep_limits, creep_ends, creep_speed, plan_creep
from calib.creep.rows import bin_readings
from calib.motion.mover import Mover, Stalled
from calib.motion.static_reading import StaticReading
from calib.plan.collisions import check_creeps
from calib.plan.types import Sweep, SweepPlan
from calib.sweep.dataset import DataWriter, PlanLine, StallLine, SweepData, load_data
from calib.sweep.run import Progress, SweepPass, new_manifest, sparkline
from calib.sweep.stalls import OnStall, give_up, repeat_work
from gcomp.arrays import Array

REST_SECONDS = 0.5
"""Rest before a creep [s]."""
MOST_CONTACT_SHARE = 0.3
"""Share of the sweeps that may end in a contact before the pass is given up."""
CONTACT_TORQUE = 1.5
"""Pull of a soft position loop that friction and gravity alone may ask for [N·m]."""


def run_creep(
    link: ArmDriver,
    arm: ArmFile,
    out: Path,
    *,
    reference_mass: float = 0.0,
    resume: bool = False,
    progress: Progress | None = None,
    seed: int = 0,
    on_stall: OnStall = give_up,
    plan: SweepPlan | None = None,
) -> SweepData:
    """One pass over all joints with `reference_mass` [kg] attached (0 for none), into the directory `out`.

    The link must have been enabled; the joints hold at the end. A joint that meets something on its way is led back;
    the sweep is then noted with the reason, and has no readings. Raises BadInput, Refused if too many sweeps do so or
    the model shows beforehand that one would touch something, BusFault; every reading made is on disk.
    """
    with DataWriter(out, new_manifest(link, arm, reference_mass, on_stall), resume) as writer:
        data = load_data(out)
        mover = repeat_work(link, on_stall, lambda: Mover(link, sweep_section(arm), DriveLimits.of(arm)))
        used = data.plan or plan or plan_creep(arm, seed=seed)
        ground = CreepGround.of(arm)
        check_creep_limits(ground, arm, used)
        if ground.geometry is not None:
            check_creeps(arm, ground.geometry, used, mover.command.position)
        if data.plan is None:
            writer.append(PlanLine(plan=used, resolution=tuple(mover.known_resolution.tolist())))
        run = _CreepPass(mover, writer, progress, on_stall, ground, used)
        run.made = {reading.sweep for reading in data.readings}
        for sweep in used.sweeps:
            if sweep.name not in run.made and not any(_names(stall, sweep) for stall in data.stalls):
                run.sweep(sweep)
        mover.hold_all()
        mover.cycle()
    return load_data(out)


def contacts(data: SweepData) -> list[StallLine]:
    """Sweeps of a pass that ended in a contact."""
    return [stall for stall in data.stalls if stall.contact]


def _names(stall: StallLine, sweep: Sweep) -> bool:
    return stall.contact and stall.reading == sweep.name


class _CreepPass(SweepPass):
    def __init__(
        self,
        mover: Mover,
        writer: DataWriter,
        progress: Progress | None,
        on_stall: OnStall,
        ground: CreepGround,
        plan: SweepPlan,
    ) -> None:
        super().__init__(mover, writer, progress, on_stall)
        self._ground, self._plan = ground, plan
        self._creep, self._home = ground.section.creep, np.array(plan.scout[0])
        self._contacts = 0
        self.made: set[str] = set()

    def sweep(self, sweep: Sweep) -> None:
        """Creep both ways and keep the readings; a contact is noted instead."""
        while True:
            try:
                readings = self._both_ways(sweep)
                break
            except Stall as stall:
                self.bridge(stall, sweep.name)
            except Stalled as stalled:
                self._note_contact(sweep, stalled)
                return
        for reading in readings:
            self.writer.append(reading)
        self.made.add(sweep.name)
        self._report(sweep, readings)

    def _both_ways(self, sweep: Sweep) -> list[StaticReading]:
        mover, joint = self.mover, sweep.joint
        middles, speed = np.array(sweep.steps), creep_speed(sweep)
        low, high = creep_ends(sweep)
        goal = np.array(sweep.rest)
        goal[joint] = low
        mover.hold_all()
        if not self._ground.way(mover.command.position, goal):
            mover.travel(self._home, self._plan.travel_acceleration)
        mover.travel(goal, self._plan.travel_acceleration)
        self._pause()
        found: list[StaticReading] = []
        temperature = self._temperature()
        count = len(middles)
        for side, end in ((1, high), (-1, low)):
            samples = mover.follow(self._rows(joint, end, speed), self._guard(joint))
            for index, reading in enumerate(bin_readings(samples, joint, side, middles, temperature)):
                if reading is not None:
                    place = index if side > 0 else 2 * count - 1 - index
                    found.append(reading.within(sweep.name, place, np.array(sweep.servo), joint, side))
            self._pause()
        return found

    def _rows(self, joint: int, end: float, speed: float) -> Array:
        """Targets of a creep at constant speed (K, n) [rad], rounded at both ends."""
        period, start = self.mover.link.period, self.mover.command.position.copy()
        distance = end - start[joint]
        total = abs(distance) / speed + RAMP
        t = np.arange(1, int(np.ceil(total / period)) + 1) * period
        up, down = np.clip(t / RAMP, 0, 1), np.clip((total - t) / RAMP, 0, 1)
        rate = np.minimum(up, down)
        rows = np.tile(start, (len(t), 1))
        rows[:, joint] = start[joint] + distance * np.cumsum(rate) / rate.sum()
        return rows

    def _guard(self, joint: int) -> ReadingBounds:
        """The creeping joint may be behind its target by `contact_lead`; the others' sag is no contact."""
        n = self.mover.link.n
        follow = np.full(n, np.inf)
        stiffness = getattr(self.mover.link.arm.require_link().joints[joint].settings, "kp", None)
        follow[joint] = max(self._creep.contact_lead, CONTACT_TORQUE / stiffness if stiffness else 0.0)
        return ReadingBounds(np.full(n, -np.inf), np.full(n, np.inf), follow)

    def _pause(self) -> None:
        for _ in range(round(REST_SECONDS / self.mover.link.period)):
            self.mover.cycle()

    def _temperature(self) -> Array | None:
        """Temperatures of the drives (n,) [°C]; None where not all report one."""
        found = self.mover.link.read_temperatures()
        return found if np.isfinite(found).all() else None

    def _note_contact(self, sweep: Sweep, stalled: Stalled) -> None:
        """Lead the joint back, and note the sweep as not made."""
        mover = self.mover
        self._contacts += 1
        mover.come_to_rest()
        text = (
            f"contact: {stalled.name}: met something at {stalled.position:.2f} rad: the surroundings, the arm"
            " itself or a cable"
        )
        line = StallLine(t=mover.seen_at, late_ms=None, reading=sweep.name, reason=text, contact=True)
        self.writer.append(line)
        self.progress(len(self.made), len(self._plan.sweeps), 0.0, text)
        if self._contacts > MOST_CONTACT_SHARE * len(self._plan.sweeps):
            raise Refused(
                f"{text}; {self._contacts} sweeps ended like this: clear the workspace, or narrow lower and upper"
            )
        goal = mover.command.position.copy()
        goal[sweep.joint] = sweep.rest[sweep.joint]
        mover.travel(goal, self._plan.travel_acceleration)

    def _report(self, sweep: Sweep, readings: list[StaticReading]) -> None:
        done, total = len(self.made), len(self._plan.sweeps)
        left = (time.monotonic() - self.began) / max(done, 1) * (total - done)
        up = [float(each.torque[sweep.joint]) for each in readings if each.direction.sum() > 0]
        self.progress(done, total, left, f"{sweep.name} {sparkline(up) if up else ''}")
