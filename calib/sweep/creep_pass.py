"""Creeps: a joint moves at constant speed both ways; all readings of a sweep are on disk before the next begins."""

from contextlib import suppress

import numpy as np

from armlink.errors import Refused, Stall
from armlink.link.reading_bounds import ReadingBounds
from calib.dataset import StallLine
from calib.motion.mover import Stalled
from calib.motion.static_reading import StaticReading, bin_readings
from calib.plan.collisions import Collided, clear_way
from calib.plan.creep_plan import (
    RAMP,
    CreepingArm,
    check_creep_limits,
    check_creeps,
    creep_ends,
    creep_seconds,
    creep_speed,
    plan_creep,
)
from calib.plan.types import Sweep, SweepPlan
from calib.sweep.sweep_pass import SweepPass
from gcomp.arrays import Array

REST_SECONDS = 0.5
"""Rest before a creep [s]."""
MOST_CONTACT_SHARE = 0.3
"""Share of the sweeps that may end in a contact before the pass is given up."""
CONTACT_TORQUE = 1.5
"""Pull of a soft position loop that friction and gravity alone may ask for [N·m]."""


class CreepPass(SweepPass):
    def planned(self, seed: int, reference_mass: float, given: SweepPlan | None) -> SweepPlan:
        """That of the data set, else the one given, else a new one: every pass of an arm has the same creeps."""
        self._plan = plan = self.data.plan or given or plan_creep(self.arm, seed=seed)
        self._creeping = CreepingArm(self.arm)
        check_creep_limits(self._creeping, self.arm, plan)
        if self._creeping.geometry is not None:
            check_creeps(self.arm, self._creeping.geometry, plan, self.mover.command.position)
        if self.data.plan is None:
            self.keep(plan)
        self._home, self._contacts = np.array(plan.scout[0]), 0
        self._made = {reading.sweep for reading in self.data.readings}
        self.expected = creep_seconds(plan)
        return plan

    def sweep(self, sweep: Sweep) -> None:
        """Creep both ways and keep the readings, unless that was done; a contact is noted instead."""
        if sweep.name in self._made or any(each.reading == sweep.name for each in self.data.contacts):
            return
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
        self._made.add(sweep.name)
        up = [float(each.torque[sweep.joint]) for each in readings if each.direction.sum() > 0]
        self.tell(len(self._made), sweep.name, up)

    def _both_ways(self, sweep: Sweep) -> list[StaticReading]:
        """Readings of a creep there and back; raises Collided, before anything moves, where the ways to it, straight
        and by the home pose, lead through contacts."""
        mover, joint = self.mover, sweep.joint
        middles, speed = np.array(sweep.steps), creep_speed(sweep)
        low, high = creep_ends(sweep)
        goal = np.array(sweep.rest)
        goal[joint] = low
        mover.hold_all()
        here, title = mover.command.position.copy(), f"on the way from its present pose to sweep {sweep.name}"
        ways = [[here, goal], [here, self._home, goal]]
        for pose in clear_way(self.arm, self._creeping.geometry, ways, title)[1:]:
            mover.travel(pose, self._plan.travel_acceleration)
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
        follow[joint] = max(self._creeping.section.creep.contact_lead, CONTACT_TORQUE / stiffness if stiffness else 0.0)
        return ReadingBounds(np.full(n, -np.inf), np.full(n, np.inf), follow)

    def _pause(self) -> None:
        for _ in range(round(REST_SECONDS / self.mover.link.period)):
            self.mover.cycle()

    def _temperature(self) -> Array | None:
        """Temperatures of the drives (n,) [°C]; None where not all report one."""
        found = self.mover.link.read_temperatures()
        return found if np.isfinite(found).all() else None

    def _note_contact(self, sweep: Sweep, stalled: Stalled) -> None:
        """Note the sweep as not made, and lead the joint back, unless something stands in the way."""
        mover = self.mover
        self._contacts += 1
        mover.come_to_rest()
        text = (
            f"contact: {stalled.name} met something at {stalled.position:.2f} rad: the surroundings, the arm "
            "itself or a cable"
        )
        line = StallLine(t=mover.seen_at, late_ms=None, reading=sweep.name, reason=text, contact=True)
        self.writer.append(line)
        self.progress(len(self._made), len(self._plan.sweeps), 0.0, text)
        if self._contacts > MOST_CONTACT_SHARE * len(self._plan.sweeps):
            raise Refused(
                f"{text}; {self._contacts} sweeps ended with a contact: clear the workspace, or narrow lower and upper"
            )
        here, goal = mover.command.position.copy(), mover.command.position.copy()
        goal[sweep.joint] = sweep.rest[sweep.joint]
        with suppress(Collided):  # then it stays until there is a way to the next sweep
            clear_way(self.arm, self._creeping.geometry, [[here, goal]], sweep.name)
            mover.travel(goal, self._plan.travel_acceleration)
