"""Through the link of a simulated arm: creep passes, then work in which the arm takes up a load and puts it down."""

from pathlib import Path

import numpy as np
import pytest
from soft_links import soft_arm

from armlink.link.link import Link
from armlink.link.types import Command
from calib.arm.kinematics import gcomp_arm
from calib.fit.creep_fit import fit_creep
from calib.motion.trajectory import trajectory
from calib.observer.decision import Event
from calib.observer.observer import observer_of
from calib.plan.creep_plan import plan_creep
from calib.sweep.run import run_sweep
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

LOAD = 0.3
"""[kg]"""


@pytest.mark.long
def test_a_load_is_told_while_the_arm_carries_it(tmp_path: Path) -> None:
    arm = soft_arm()
    simulated, plan, random = SimulatedArm(arm, Truth.draw(arm, 3), 3), plan_creep(arm), np.random.default_rng(0)
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        link.enable()
        passes = []
        for name, mass in (("empty", 0.0), ("loaded", plan.reference_mass), ("again", 0.0)):
            simulated.attach_mass(mass)
            passes.append(run_sweep(link, arm, tmp_path / name, reference_mass=mass, plan=plan))
        fit = fit_creep(arm, passes)
        record = fit.record(arm)
        rated = arm.require_link().rated_torques
        watching = observer_of(gcomp_arm(arm), record, fit.gravity.record(arm, record), rated)
        held = record.torque_calibration()

        def work(rows: int) -> list[Event]:
            events, end = list[Event](), watching.rows + rows
            while watching.rows < end:
                goal = random.uniform([-1.2, -1.4], [1.2, 1.4])
                speed, acceleration = np.full(2, random.uniform(0.15, 0.5)), np.full(2, 2.0)
                for target in trajectory(link.position_sent.copy(), goal, speed, acceleration, link.period):
                    sample = link.cycle(Command.hold(target))
                    events += watching.handle(sample.t, sample.position, held.invert(sample.torque))
            return events

        simulated.attach_mass(0.0)
        assert work(240) == []
        simulated.attach_mass(LOAD)
        (taken,) = work(240)
        simulated.attach_mass(0.0)
        (put_down,) = work(300)
    assert taken.evidence["cause"] == "payload"
    assert abs(taken.evidence["mass"] - LOAD) < 0.1 * LOAD
    assert put_down.evidence["cause"] == "none"
