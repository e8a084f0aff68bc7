"""Runs one pass of sweeps through the link, by steps at rest or by creeping, as the arm asks for."""

from pathlib import Path

from armlink.arm_file import ArmFile
from armlink.loop.open import ArmDriver
from calib.arm.kinematics import DriveLimits
from calib.arm.sweep_section import sweep_motion, sweep_section
from calib.dataset import DataWriter, Manifest, SweepData, load_data
from calib.motion.mover import Mover
from calib.plan.types import SweepPlan
from calib.sweep.creep_pass import CreepPass
from calib.sweep.step_pass import StepPass
from calib.sweep.sweep_pass import OnStall, Progress, give_up, repeat_work


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
    plan: SweepPlan | None = None,
    bus: str | None = None,
) -> SweepData:
    """One pass over all joints with `reference_mass` [kg] attached (0 for none), into the directory `out`.

    The link must have been enabled; the joints hold at the end. Steps begin with the scout, which finds the bias
    torques; creeps follow `plan` where one is given. With `resume` it goes on after the last reading on disk. After a
    Stall that `on_stall` accepts the joints are enabled again and the interrupted reading is repeated; a creeping joint
    that meets something is led back, and its sweep is noted with the reason and has no readings. `bus` is what was
    given instead of the arm file's. Raises BadInput, Refused if the arm cannot be swept or too many creeps meet
    something, BusFault; every reading made is on disk.
    """
    installed = repeat_work(link, on_stall, lambda: [link.read_calibration(joint) for joint in range(link.n)])
    drives = repeat_work(link, on_stall, lambda: [link.drive_serial(joint).number for joint in range(link.n)])
    with DataWriter(out, Manifest.of(arm, reference_mass, installed, drives, bus), resume) as writer:
        mover = repeat_work(link, on_stall, lambda: Mover(link, sweep_section(arm), DriveLimits.of(arm)))
        kind = CreepPass if sweep_motion(arm) == "creep" else StepPass
        run = kind(arm, mover, writer, load_data(out), progress, on_stall)
        for sweep in run.planned(seed, reference_mass, plan).sweeps:
            run.sweep(sweep)
        run.rest()
    return load_data(out)
