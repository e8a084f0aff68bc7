"""Runs the demo: sweep, calibrate, identify, verify, record, drift and recalibrate or float, diagnose, report.

Every step is one call of the product; the demo's own are the hidden truth, the operator's hands and the order.
"""

import shutil
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from rich.console import Console

from armlink.arm_file import MODEL_SUFFIXES, ArmFile, load_arm
from armlink.commands.output import write_json
from armlink.commands.plain_console import results
from armlink.errors import BadInput
from armlink.extras import require_extra
from armlink.recording.recording import Recording
from calib.arm.kinematics import gcomp_arm, model_arm
from calib.arm.sweep_section import CreepSection, sweep_section
from calib.commissioning.model_judgement import refuse_impossible_model
from calib.commissioning.new_arm import new_arm
from calib.creep.choice import sweep_motion
from calib.creep.fit import fit_creep
from calib.creep.plan import plan_creep
from calib.creep.record import CreepCalibration, gravity_fit
from calib.creep.run import contacts, run_creep
from calib.creep.verify import verify_creeping
from calib.fit.gravity_fit import identify_gravity
from calib.fit.sensor_fit import fit_sensors
from calib.install.apply import Apply, admit_sweeps
from calib.install.journaled_write import install
from calib.install.plausibility import admit
from calib.plan.types import Sweep, SweepPlan
from calib.records.records import CalibrationRecord
from calib.records.store import RecordStore
from calib.sweep.dataset import SweepData
from calib.sweep.run import run_sweep
from calib.sweep.verify import Verification, run_verify
from sim_bus.sim_section import with_realism
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.demo.bench import Bench, Sag, check_gravity, diagnose_recordings, mean_sag, record_pair, sag_poses
from sim_gap.demo.drift import run_drift
from sim_gap.demo.narrator import Narrator
from sim_gap.demo.result import DemoResult, summary
from sim_gap.demo.tables import calibration_table, creep_table, verify_table
from sim_gap.report.effect_text import sentence

BY = "armlink demo"
QUICK = CreepSection(span=1.1, speeds=(0.2, 0.14))
"""Shorter and faster creeps than on a real arm, for two minutes: they cost a factor of two in precision."""


def run_demo(
    arm_name: str, *, seed: int, out: Path, json_path: Path | None, console: Console, realism: float | None = None
) -> DemoResult:
    """Run it, write `report.html`, `summary.json` and the data into `out`; raises BadInput, Refused, BusFault."""
    teller = Narrator(console, results(json_path))
    if Path(arm_name).suffix.lower() in MODEL_SUFFIXES:
        arm_name = str(_from_model(Path(arm_name), out, teller))
    arm = load_arm(arm_name)
    if realism is not None:
        arm = with_realism(arm, realism, seed)
    arm.require_link()
    refuse_impossible_model(arm)
    data_folder = _fresh(out)
    teller.say(f"arm {arm.name}, hidden truth of seed {seed}, results in {out}")
    creeping = sweep_motion(arm) == "creep"
    arm = quick(arm) if creeping else arm
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as other_core:
        bench = Bench.build(arm, gcomp_arm(arm), seed)
        store = RecordStore(str(data_folder / "records.sqlite"))
        with bench.link:
            demo = _Demo(bench, store, seed, data_folder, teller, other_core)
            result = demo.creep_demo() if creeping else demo.sensor_demo()
        store.close()
    if result.creep is not None:
        teller.results.print(creep_table(result, result.creep))
    shown = _report(result, out / "report.html")
    content = summary(result)
    write_json(out / "summary.json", content)
    write_json(json_path, content)
    teller.find(f"done: {shown}; numbers in {out / 'summary.json'}")
    return result


def _report(result: DemoResult, path: Path) -> str:
    """Write the report, and say what to open; without the packages that draw it, how they are installed."""
    try:
        require_extra(f"no {path}", "reports")
    except BadInput as missing:
        return str(missing)
    from sim_gap.demo.report import write_report

    write_report(result, path)
    return f"open {path}"


def quick(arm: ArmFile) -> ArmFile:
    """The arm with the demo's creeps, where its file states none."""
    section = sweep_section(arm)
    if "creep" in section.model_fields_set:
        return arm
    return arm.model_copy(update={"sweep": section.model_copy(update={"creep": QUICK})})


@dataclass
class _Demo:
    """One demo as it goes on; its methods raise BadInput, Refused, BusFault."""

    bench: Bench
    store: RecordStore
    seed: int
    folder: Path
    teller: Narrator
    other_core: ProcessPoolExecutor

    def sensor_demo(self) -> DemoResult:
        """An arm with torque sensors, one of which drifts."""
        link, arm, store, seed, teller = self.bench.link, self.bench.arm, self.store, self.seed, self.teller
        self._enable(f"{link.n} nodes found on the bus, mapped and enabled; SYNC at {link.rate:g} Hz")
        data = self._sweeps()
        self._look_at_truth()
        with teller.stage("fitting sensors and mass moments, all joints together"):
            sensors = fit_sensors(arm, data)
        gravity = identify_gravity(arm, data, sensors)
        record = sensors.record(arm)
        gravity_record = gravity.record(arm, record)
        store.put(gravity_record, arm, by=BY, reason="sweeps")
        apply = Apply(BY, accepted=arm.joint_names)
        admitted = admit_sweeps(record, arm, store, data, sensors.goodness.findings, apply)
        written = install(admitted, store, link, by=BY, reason="sweeps without and with reference mass", check=None)
        teller.results.print(calibration_table(self.bench, sensors))
        teller.say(f"record {record.id} written to {len(written)} controllers and read back")
        check = self._verified(
            "verifying at poses that the fit has not seen",
            lambda progress: run_verify(link, arm, gravity_record, record, seed=seed, progress=progress),
        )
        gravity_check = check_gravity(self.bench, gravity.beta, record, seed)
        teller.results.print(verify_table(link.names, check, gravity_check))
        recordings, diagnosis = self._recorded(record, (40.0, 25.0), motor_only=False)
        with teller.stage("ordinary work: a torque sensor will drift") as report:
            drift = run_drift(self.bench, store, gravity_record, check, seed, report)
        teller.find(drift.sentence(link.names))
        with teller.stage("diagnosing the gap between the recording and the nominal simulation"):
            try:
                gap = diagnosis.result()
            except BrokenProcessPool:
                teller.say("the process that did it was killed: doing it again in this one")
                gap = diagnose_recordings(arm.path, recordings)
        teller.find(sentence(gap))
        result = DemoResult(self.bench, seed, sensors, gravity_check, check, gap, link.stats, 0.0, 0.0, drift=drift)
        return self._ended(result)

    def creep_demo(self) -> DemoResult:
        """An arm without torque sensors: creep sweeps, records in the host, and how far the arm sags with them."""
        link, arm, store, seed, teller = self.bench.link, self.bench.arm, self.store, self.seed, self.teller
        self._enable(f"{link.n} drives found on the bus, set up and enabled; {link.rate:g} cycles a second")
        plan = plan_creep(arm, seed=seed)
        for note in plan.notes:
            teller.say(note)
        passes = self._creeps(plan)
        for data in passes:
            for each in contacts(data):
                teller.say(each.reason)
        with teller.stage("fitting torque constants, friction, zeros and mass moments, all joints together"):
            fit = fit_creep(arm, passes)
        self._look_at_truth()
        sensors, nominal, sag = CreepCalibration(fit), None, None
        record = sensors.record(arm)
        gravity = gravity_fit(fit).record(arm, record)
        store.put(gravity, arm, by=BY, reason="creep sweeps")
        if arm.model_path is not None:
            with teller.stage("holding poses by a tenth of the gains and the nominal model"):
                nominal = mean_sag(self.bench, plan, model_arm(arm).beta, np.zeros(link.n))
        install(admit(record, arm, store), store, link, by=BY, reason="creep sweeps", check=None)
        teller.say(f"record {record.id} kept by the host and in force: it corrects readings and commands")
        _, diagnosis = self._recorded(record, (30.0, 20.0), motor_only=True)
        check = self._verified(
            "verifying at poses that the fit has not seen, creeping both ways",
            lambda progress: verify_creeping(link, arm, gravity, record, poses=8, seed=seed, progress=progress),
        )
        gravity_check = check_gravity(self.bench, fit.beta, record, seed)
        if nominal is not None:
            with teller.stage("holding the same poses by a tenth of the gains and the records"):
                zero = record.values("position_offset", 0.0)
                sag = Sag(nominal, mean_sag(self.bench, plan, fit.beta, zero), len(sag_poses(plan)))
        with teller.stage("diagnosing the gap between the recording and the nominal simulation"):
            gap = diagnosis.result()
        return self._ended(
            DemoResult(self.bench, seed, sensors, gravity_check, check, gap, link.stats, 0.0, 0.0, sag=sag)
        )

    def _enable(self, said: str) -> None:
        self.bench.link.start()
        self.bench.link.enable()
        self.teller.say(said)

    def _look_at_truth(self) -> None:
        """Keep the sensors as they are now: zeros move as the arm warms up."""
        self.bench = replace(self.bench, truth=self.bench.simulated.true_sensors)

    def _sweeps(self) -> tuple[SweepData, SweepData]:
        """Both passes; between them the operator bolts the reference mass on, somewhere the fit is not told."""
        bench = self.bench
        with self.teller.stage("sweeping each joint, tip to base, the others pressed on their stops") as report:
            bare = run_sweep(bench.link, bench.arm, self.folder / "unloaded", progress=report, seed=self.seed)
        assert bare.plan is not None
        mass, folder = bare.plan.reference_mass, self.folder / "loaded"
        bench.simulated.attach_mass(mass)
        with self.teller.stage(f"sweeping again with a reference mass of {mass:g} kg on the hand") as report:
            loaded = run_sweep(bench.link, bench.arm, folder, reference_mass=mass, progress=report, seed=self.seed)
        bench.simulated.detach_mass()
        return bare, loaded

    def _creeps(self, plan: SweepPlan) -> tuple[SweepData, ...]:
        """Empty, loaded, empty: what changes as the drives warm up is then not taken for the mass."""
        bench, first = self.bench, dict[int, Sweep]()
        for sweep in plan.sweeps:
            first.setdefault(sweep.joint, sweep)
        short = plan.model_copy(update={"sweeps": tuple(first.values())})
        mass, made = plan.reference_mass, []
        for name, load, used in (("unloaded", 0.0, plan), ("loaded", mass, plan), ("unloaded-again", 0.0, short)):
            if load:
                bench.simulated.attach_mass(load)
            else:
                bench.simulated.detach_mass()
            text = f"with {load:g} kg on the hand" if load else "without a load"
            with self.teller.stage(f"creeping through each joint's range both ways, {text}") as report:
                folder = self.folder / name
                made.append(run_creep(bench.link, bench.arm, folder, reference_mass=load, progress=report, plan=used))
        return tuple(made)

    def _verified(self, headline: str, verify: Callable[[Callable[[int, int], None]], Verification]) -> Verification:
        with self.teller.stage(headline) as report:
            return verify(lambda k, n: report(k, n, None, f"pose {k}"))

    def _recorded(
        self, record: CalibrationRecord, seconds: tuple[float, float], *, motor_only: bool
    ) -> tuple[tuple[Recording, Recording], Future[Diagnosis]]:
        """Motion to learn from and to judge on, and its diagnosis on the other core."""
        with self.teller.stage("recording motion for the gap diagnosis") as report:
            both = record_pair(self.bench, record, self.folder, self.seed, seconds, report, motor_only=motor_only)
        return both, self.other_core.submit(diagnose_recordings, self.bench.arm.path, both)

    def _ended(self, result: DemoResult) -> DemoResult:
        """The result with its times, once the drives are off."""
        self.bench.link.disable()
        return replace(result, wall_s=self.teller.elapsed, sim_s=self.bench.simulated.time)


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
