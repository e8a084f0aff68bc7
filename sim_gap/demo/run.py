"""Runs the demo: sweep, calibrate, identify, verify, record, drift and recalibrate, diagnose, report."""

import shutil
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rich.console import Console

from armlink.arm_file import MODEL_SUFFIXES, ArmFile, load_arm
from armlink.commands.output import write_json
from armlink.commands.plain_console import results
from armlink.errors import BadInput
from calib.arm.kinematics import gcomp_arm
from calib.commissioning.new_arm import new_arm
from calib.creep.choice import sweep_motion
from calib.fit.gravity_fit import identify_gravity
from calib.fit.sensor_fit import fit_sensors
from calib.install.apply import Apply, admit_sweeps
from calib.install.journaled_write import install
from calib.records.store import RecordStore
from calib.sweep.dataset import SweepData
from calib.sweep.run import run_sweep
from calib.sweep.verify import run_verify
from sim_bus.sim_section import with_realism
from sim_gap.demo.bench import Bench, check_gravity
from sim_gap.demo.creep_report import creep_table, write_creep_report
from sim_gap.demo.creep_report import summary as creep_summary
from sim_gap.demo.creep_run import CreepDemo, quick, run_creep_demo
from sim_gap.demo.drift import run_drift
from sim_gap.demo.gap import diagnose_recordings
from sim_gap.demo.motion import record_pair
from sim_gap.demo.narrator import Narrator
from sim_gap.demo.report import write_report
from sim_gap.demo.script import BY, RECORDED_S
from sim_gap.demo.show import calibration_table, drift_line, gap_line, verify_table
from sim_gap.demo.summary import DemoResult, DemoRun, summary


def run_demo(
    arm_name: str, *, seed: int, out: Path, json_path: Path | None, console: Console, realism: float | None = None
) -> DemoResult | CreepDemo:
    """Run it, write `report.html`, `summary.json` and the data into `out`; raises BadInput, Refused, BusFault."""
    teller = Narrator(console, results(json_path))
    if Path(arm_name).suffix.lower() in MODEL_SUFFIXES:
        arm_name = str(_from_model(Path(arm_name), out, teller))
    arm = load_arm(arm_name)
    if realism is not None:
        arm = with_realism(arm, realism, seed)
    arm.require_link()
    data_folder = _fresh(out)
    teller.say(f"arm {arm.name}, hidden truth of seed {seed}, results in {out}")
    creeping = sweep_motion(arm) == "creep"
    arm = quick(arm) if creeping else arm
    result: DemoResult | CreepDemo
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as other_core:
        bench = Bench.build(arm, gcomp_arm(arm), seed)
        store = RecordStore(str(data_folder / "records.sqlite"))
        with bench.link:
            if creeping:
                result = run_creep_demo(bench, store, seed, data_folder, teller, other_core)
            else:
                result = _work(bench, store, arm, seed, data_folder, teller, other_core)
        store.close()
    content = _told(result, out / "report.html", teller)
    write_json(out / "summary.json", content)
    write_json(json_path, content)
    teller.find(f"done: open {out / 'report.html'}; numbers in {out / 'summary.json'}")
    return result


def _told(result: DemoResult | CreepDemo, report: Path, teller: Narrator) -> dict[str, Any]:
    """Write the report; the summary."""
    if isinstance(result, CreepDemo):
        teller.show(creep_table(result))
        write_creep_report(result, report)
        return creep_summary(result)
    write_report(result, report)
    return summary(result)


def _work(
    bench: Bench,
    store: RecordStore,
    arm: ArmFile,
    seed: int,
    folder: Path,
    teller: Narrator,
    other_core: ProcessPoolExecutor,
) -> DemoResult:
    link = bench.link
    link.start()
    link.enable()
    teller.say(f"{link.n} nodes found on the bus, mapped and enabled; SYNC at {link.rate:g} Hz")
    data = _sweeps(bench, folder, seed, teller)
    bench = replace(bench, truth=bench.simulated.true_sensors)  # zeros move as the arm warms up
    with teller.stage("fitting sensors and mass moments, all joints together"):
        sensors = fit_sensors(arm, data)
    gravity = identify_gravity(arm, data, sensors)
    record = sensors.record(arm)
    gravity_record = gravity.record(arm, record)
    store.put(gravity_record, arm, by=BY, reason="sweeps")
    admitted = admit_sweeps(record, arm, store, data, sensors.goodness.findings, Apply(BY, accepted=arm.joint_names))
    written = install(admitted, store, link, by=BY, reason="sweeps without and with reference mass", check=None)
    teller.show(calibration_table(bench, sensors))
    teller.say(f"record {record.id} written to {len(written)} controllers and read back")
    with teller.stage("verifying at poses that the fit has not seen") as report:
        check = run_verify(
            link, arm, gravity_record, record, seed=seed, progress=lambda k, n: report(k, n, None, f"pose {k}")
        )
    gravity_check = check_gravity(bench, gravity.beta, record, seed)
    teller.show(verify_table(link.names, check, gravity_check))
    with teller.stage("recording motion for the gap diagnosis") as report:
        recordings = record_pair(bench, record, folder, seed, RECORDED_S, report)
    diagnosis = other_core.submit(diagnose_recordings, arm.path, recordings)
    with teller.stage("ordinary work: a torque sensor will drift") as report:
        drift = run_drift(bench, store, gravity_record, check, seed, report)
    teller.find(drift_line(link.names, drift))
    with teller.stage("diagnosing the gap between the recording and the nominal simulation"):
        try:
            answer = diagnosis.result()
        except BrokenProcessPool:
            teller.say("the process that did it was killed: doing it again in this one")
            answer = diagnose_recordings(arm.path, recordings)
    teller.find(gap_line(answer))
    stats = link.stats
    link.disable()
    run = DemoRun(bench, seed, gravity_check, check, answer, stats, teller.elapsed, bench.simulated.time)
    return DemoResult(run, sensors, gravity, drift)


def _sweeps(bench: Bench, folder: Path, seed: int, teller: Narrator) -> tuple[SweepData, SweepData]:
    """Both passes; between them the operator bolts the reference mass on, somewhere the fit is not told."""
    with teller.stage("sweeping each joint, tip to base, the others pressed on their stops") as report:
        bare = run_sweep(bench.link, bench.arm, folder / "unloaded", progress=report, seed=seed)
    assert bare.plan is not None
    mass = bare.plan.reference_mass
    bench.simulated.attach_mass(mass)
    with teller.stage(f"sweeping again with a reference mass of {mass:g} kg on the hand") as report:
        loaded = run_sweep(bench.link, bench.arm, folder / "loaded", reference_mass=mass, progress=report, seed=seed)
    bench.simulated.detach_mass()
    return bare, loaded


def _from_model(model: Path, out: Path, teller: Narrator) -> Path:
    """The arm file made of a URDF or MJCF model, in the demo's folder; raises BadInput, Refused."""
    path = out / f"{model.stem}.yaml"
    teller.say(f"making an arm file of {model}")
    made = new_arm(model, path)
    made.write()
    teller.say(f"{path}: {len(made.draft.joints)} joints, {len(made.draft.assumed)} assumed values, each says so there")
    return path


def _fresh(out: Path) -> Path:
    """The folder for the data, empty; an earlier demo's is replaced, anything else is not touched."""
    data = out / "data"
    if data.exists():
        if not (data / ".armlink-demo").exists():
            raise BadInput(f"{data}: exists and is not an earlier demo's: choose another folder with --out")
        shutil.rmtree(data)
    try:
        data.mkdir(parents=True)
        (data / ".armlink-demo").touch()
    except OSError as error:
        raise BadInput(f"{out}: cannot be written: {error.strerror}") from None
    return data
