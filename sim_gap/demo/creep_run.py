"""The demo of an arm without torque sensors: creep sweeps, fit, records in the host, verification, float, gap."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armlink.arm_file import ArmFile
from calib.arm.kinematics import model_arm
from calib.arm.sweep_section import CreepSection, sweep_section
from calib.creep.fit import CreepFit, fit_creep
from calib.creep.plan import plan_creep
from calib.creep.record import calibration_record, gravity_record
from calib.creep.run import contacts, run_creep
from calib.creep.verify import verify_creeping
from calib.install.journaled_write import install
from calib.install.plausibility import admit
from calib.plan.types import Sweep, SweepPlan
from calib.records.records import CalibrationRecord
from calib.records.store import RecordStore
from calib.sweep.dataset import SweepData
from gcomp.arrays import Array
from sim_gap.demo.bench import Bench, check_gravity
from sim_gap.demo.gap import diagnose_recordings
from sim_gap.demo.motion import record_pair
from sim_gap.demo.narrator import Narrator
from sim_gap.demo.sag import Sag, mean_sag, sag_poses
from sim_gap.demo.script import BY, CREEP_RECORDED_S
from sim_gap.demo.summary import DemoRun

QUICK = CreepSection(span=1.1, speeds=(0.2, 0.14))
"""Shorter and faster creeps than on a real arm, for two minutes: they cost a factor of two in precision."""


@dataclass(frozen=True, eq=False)
class CreepDemo:
    """Demo of an arm without torque sensors."""

    run: DemoRun
    coulomb: Array
    """True Coulomb friction (n,) [N·m]."""
    fit: CreepFit
    record: CalibrationRecord
    sag: Sag | None


def quick(arm: ArmFile) -> ArmFile:
    """The arm with the demo's creeps, where its file states none."""
    section = sweep_section(arm)
    if "creep" in section.model_fields_set:
        return arm
    return arm.model_copy(update={"sweep": section.model_copy(update={"creep": QUICK})})


def run_creep_demo(
    bench: Bench,
    store: RecordStore,
    seed: int,
    folder: Path,
    teller: Narrator,
    other_core: ProcessPoolExecutor,
) -> CreepDemo:
    """From enabling to the diagnosis; raises BadInput, Refused, BusFault."""
    link, arm = bench.link, bench.arm
    link.start()
    link.enable()
    teller.say(f"{link.n} drives found on the bus, set up and enabled; {link.rate:g} cycles a second")
    plan = plan_creep(arm, seed=seed)
    for note in plan.notes:
        teller.say(note)
    passes = _passes(bench, plan, folder, teller)
    for data in passes:
        for each in contacts(data):
            teller.say(each.reason)
    with teller.stage("fitting torque constants, friction, zeros and mass moments, all joints together"):
        fit = fit_creep(arm, passes)
    bench = replace(bench, truth=bench.simulated.true_sensors)
    record = calibration_record(fit, arm)
    gravity = gravity_record(fit, arm, record)
    store.put(gravity, arm, by=BY, reason="creep sweeps")
    nominal = None
    if arm.model_path is not None:
        with teller.stage("holding poses by a tenth of the gains and the nominal model"):
            nominal = mean_sag(bench, plan, model_arm(arm).beta, np.zeros(link.n))
    install(admit(record, arm, store), store, link, by=BY, reason="creep sweeps", check=None)
    teller.say(f"record {record.id} kept by the host and in force: it corrects readings and commands")
    with teller.stage("recording motion for the gap diagnosis") as report:
        recordings = record_pair(bench, record, folder, seed, CREEP_RECORDED_S, report, motor_only=True)
    diagnosis = other_core.submit(diagnose_recordings, arm.path, recordings)
    with teller.stage("verifying at poses that the fit has not seen, creeping both ways") as report:
        check = verify_creeping(
            link, arm, gravity, record, poses=8, seed=seed, progress=lambda k, n: report(k, n, None, f"pose {k}")
        )
    gravity_check = check_gravity(bench, fit.beta, record, seed)
    sag = None
    if nominal is not None:
        with teller.stage("holding the same poses by a tenth of the gains and the records"):
            zero = record.values("position_offset", 0.0)
            sag = Sag(nominal, mean_sag(bench, plan, fit.beta, zero), len(sag_poses(plan)))
    with teller.stage("diagnosing the gap between the recording and the nominal simulation"):
        answer = diagnosis.result()
    stats = link.stats
    link.disable()
    run = DemoRun(bench, seed, gravity_check, check, answer, stats, teller.elapsed, bench.simulated.time)
    return CreepDemo(run, bench.simulated.true_friction, fit, record, sag)


def _passes(bench: Bench, plan: SweepPlan, folder: Path, teller: Narrator) -> tuple[SweepData, ...]:
    """Empty, loaded, empty: what changes as the drives warm up is then not taken for the mass."""
    short = plan.model_copy(update={"sweeps": _first_of_each(plan)})
    mass, made = plan.reference_mass, []
    for name, load, used in (("unloaded", 0.0, plan), ("loaded", mass, plan), ("unloaded-again", 0.0, short)):
        if load:
            bench.simulated.attach_mass(load)
        else:
            bench.simulated.detach_mass()
        text = f"with {load:g} kg on the hand" if load else "without a load"
        with teller.stage(f"creeping through each joint's range both ways, {text}") as report:
            made.append(
                run_creep(bench.link, bench.arm, folder / name, reference_mass=load, progress=report, plan=used)
            )
    return tuple(made)


def _first_of_each(plan: SweepPlan) -> tuple[Sweep, ...]:
    """The first sweep of every joint."""
    first: dict[int, Sweep] = {}
    for sweep in plan.sweeps:
        first.setdefault(sweep.joint, sweep)
    return tuple(first.values())


def worst_gain_error(result: CreepDemo) -> float:
    """Largest relative error of the gains that were found."""
    found = result.fit.found("gain")
    return float(np.abs(result.fit.value("gain") / result.run.truth.gain - 1)[found].max(initial=0.0))
