"""Runs the demo: each step is a call of the product; the demo's own are the hidden truth, the operator, the order."""

import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.text import Text

from armlink import Recording, calibrate, diagnose, identify, load_arm, sweep, verify
from armlink.arm_file import ArmFile
from armlink.commands.output import write_json
from armlink.commands.plain_console import PlainConsole, command_line, results, suggest
from armlink.content.atomic_file import writing
from armlink.content.printable_text import printable_text
from armlink.errors import BadInput
from armlink.extras import has_extra
from armlink.link.types import Sample
from armlink.model_file import MODEL_SUFFIXES
from calib.api import Calibrated
from calib.arm.kinematics import model_arm
from calib.arm.sweep_section import CreepSection, sweep_motion, sweep_section
from calib.commands.screen import SweepScreen, print_intervals
from calib.commissioning.draft import assumed_lines
from calib.commissioning.model_checks import refuse_impossible_sweep
from calib.commissioning.new_arm import new_arm
from calib.daemon.state.events import describe
from calib.dataset import SweepData
from calib.fit.creep_fit import CreepFit
from calib.install.journaled_write import install
from calib.install.plausibility import admit
from calib.motion.trajectory import WorkMotion, work_targets
from calib.observer.observer import observer_of
from calib.observer.recalibrator import Recalibrator
from calib.observer.watch_loop import WatchHistory, watch
from calib.plan.types import SweepPlan
from calib.records.records import CalibrationRecord, GravityRecord
from calib.records.store import RecordStore
from calib.report import calibration
from calib.report.figures import verify_figure, watch_figure
from calib.report.page import ReportSection, bullets, paragraph, render
from calib.report.tables import ReportTable, interval_table
from calib.sweep.run import run_sweep
from calib.sweep.verify import Verification
from gcomp.arrays import Array
from sim_bus.sim_section import with_realism
from sim_bus.truth import Truth
from sim_gap.attribution.diagnosis import plain_json
from sim_gap.demo.bench import Bench, drifting_joint, sag_poses
from sim_gap.model.load import load_compiled
from sim_gap.report.effect_text import sentence
from sim_gap.report.page import sections as gap_sections

BY = "armlink demo"
OPENED = "The fit saw only what came over the bus. The true values were opened only after everything was estimated."
SUFFIX = ".mcap" if has_extra("bags") else ".csv.gz"
QUICK = CreepSection(span=1.1, speeds=(0.2, 0.14))
"""Shorter and faster creeps than on a real arm, for two minutes: they cost a factor of two in precision."""
DRIFT_GAIN, DRIFT_OFFSET, DRIFT_OFFSET_SHARE = 1.03, 0.3, 0.05
"""Factor on the sensor's readings; offset added to them [N·m], at most this share of rated torque."""
QUIET_SECONDS, WORK_SECONDS, WATCHED_SECONDS = 30.0, 300.0, 15.0
"""Ordinary work before the drift begins, at most, and after a recalibration [s]."""
WATCHED = (
    "At every stop the observer compares gravity and sensors. Estimates are relative to the calibration that "
    "was current at that time."
)


def run_demo(arm_name: str, *, seed: int, out: Path, json_path: Path | None, realism: float | None = None) -> None:
    """Run it, write `report.html`, `summary.json` and the data into `out`; raises BadInput, Refused, BusFault."""
    account = Account(json_path)
    if Path(arm_name).suffix.lower() in MODEL_SUFFIXES:
        made = new_arm(Path(arm_name), out / f"{Path(arm_name).stem}.yaml")
        made.write()
        arm_name, joints, assumed = str(made.out), len(made.draft.joints), len(assumed_lines(made.text))
        account.say(
            f"{arm_name} was made from the model: {joints} joints; {assumed} values are assumed, each is marked "
            "in the file"
        )
    arm = load_arm(arm_name)
    if realism is not None:
        arm = with_realism(arm, realism, seed)
    refuse_impossible_sweep(arm, 0.0)
    bench, data = Bench(quick(arm), seed), _fresh(out)
    account.say(f"arm {arm.name} with the hidden true values of seed {seed}; the results are in {out}")
    account.note(arm=arm.name, seed=seed, joints=arm.joint_names)
    Demo(bench, seed, data, account).run()
    account.write(out, f"simulated arm {arm.name} with the hidden true values of seed {seed}")
    real = f"{command_line('new', arm_name)} --force --bus socketcan:can0 --by-hand"
    suggest(real if Path(arm_name).suffix else "armlink new MODEL.urdf")


class Account:
    """The demo's account of itself: lines in the terminal, `summary.json` (schema armlink.demo/1), and the page."""

    def __init__(self, json_path: Path | None) -> None:
        self.summary: dict[str, Any] = {}
        self.sections: list[ReportSection] = []
        self._findings, self.began = list[str](), time.monotonic()
        self._json, self._results, self._console = json_path, results(json_path), PlainConsole()

    def say(self, text: str, style: str = "", console: PlainConsole | None = None) -> None:
        line = Text.assemble((f"{time.monotonic() - self.began:5.0f} s", "dim"), "  ", (printable_text(text), style))
        (console or self._console).print(line)

    @contextmanager
    def stage(self, headline: str) -> Iterator[SweepScreen]:
        self.say(headline, "bold")
        with SweepScreen("") as screen:
            yield screen

    def find(self, text: str) -> None:
        """A result in a sentence, without a full stop."""
        self._findings.append(f"{text}.")
        self.say(text, console=self._results)

    def table(self, title: str, names: tuple[str, ...], columns: Mapping[str, tuple[Array, Array]]) -> ReportTable:
        """Print a table; returns it for a section. `columns` maps heading to (value, half of its 95 % interval)."""
        print_intervals(title, names, dict(columns), self._results)
        return interval_table(names, columns, f"{title}.")

    def note(self, **values: Any) -> None:
        """Add to the summary: numbers with seven digits, null where one is not finite."""
        self.summary |= plain_json(values, digits=7)

    def write(self, out: Path, subtitle: str) -> None:
        """Write `report.html` and `summary.json`; raises OSError."""
        short = ReportSection("In short", paragraph(OPENED) + bullets(self._findings))
        render(out / "report.html", "armlink demo", [short, *self.sections], subtitle)
        summary = {"schema": "armlink.demo/1", **self.summary}
        for path in (out / "summary.json", self._json):
            write_json(path, summary)
        self.say(f"done: open {out / 'report.html'}; the numbers are in {out / 'summary.json'}", console=self._results)


def quick(arm: ArmFile) -> ArmFile:
    """The arm with the demo's creeps, where it creeps and its file states none."""
    section = sweep_section(arm)
    if sweep_motion(arm) != "creep" or "creep" in section.model_fields_set:
        return arm
    return arm.model_copy(update={"sweep": section.model_copy(update={"creep": QUICK})})


def _fresh(out: Path) -> Path:
    """The folder for the data, empty; an earlier demo's is replaced, anything else is not touched."""
    data = out / "data"
    if data.exists() and not (data / ".armlink-demo").exists():
        raise BadInput(f"{data} exists and was not written by an earlier demo: choose another folder with --out")
    with writing(out):
        shutil.rmtree(data, ignore_errors=True)
        data.mkdir(parents=True)
        (data / ".armlink-demo").touch()
    return data


def last_word(history: WatchHistory, after: float) -> str:
    """The observer's last event from `after` on, in words: why it changed nothing."""
    said = [describe(event)[1] for event in history.events if event.t >= after]
    return said[-1] if said else "the observer saw no change"


class Demo:
    """One demo; its methods raise BadInput, Refused, BusFault."""

    def __init__(self, bench: Bench, seed: int, folder: Path, account: Account) -> None:
        self.bench, self.seed, self.folder, self.account = bench, seed, folder, account
        self.store = RecordStore(str(folder / "records.sqlite"))

    def run(self) -> None:
        bench, link, arm, account = self.bench, self.bench.link, self.bench.arm, self.account
        with link:
            link.start()
            link.enable()
            account.say(f"{link.n} simulated drives were found, set up and enabled; {link.rate:g} cycles a second")
            passes = self._passes()
            truth = bench.simulated.true_sensors  # as they are now: zeros move as the arm warms up
            account.say("fitting sensors and mass moments, all joints together", "bold")
            sensors = calibrate(*passes, arm=arm)
            gravity = identify(*passes, arm=arm, sensors=sensors)
            record = sensors.record(arm)
            model = gravity.record(arm, record)
            self._tell_sensors(passes, sensors, record, truth)
            self.store.put(model, arm, by=BY, reason="sweeps")
            plan = passes[0].plan if bench.creeping and arm.model_path is not None else None
            sags = {} if plan is None else self._sag(plan, "nominal", model_arm(arm).beta, np.zeros(link.n))
            install(admit(record, arm, self.store), self.store, link, by=BY, reason="sweeps", check=None)
            kept = "stored by the host" if bench.creeping else f"written to {link.n} drives and read back"
            account.say(f"record {record.id} {kept}")
            if bench.creeping:
                recordings, check = self._recordings(record, 30.0, 20.0), self._verified(model, record, 8)
            else:
                check, recordings = self._verified(model, record, 24), self._recordings(record, 40.0, 25.0)
            if plan is not None:
                sags |= self._sag(plan, "calibrated", gravity.beta, record.values("position_offset", 0.0))
                account.note(sag={"poses": len(sag_poses(plan)), **sags})
            self._tell_gravity(check, bench.gravity_errors(truth, gravity.beta, record, self.seed), sags)
            if not bench.creeping:
                self._drift(record, model, check)
            bus = link.stats
            link.disable()
        account.say("diagnosing the gap between the recording and the nominal simulation", "bold")
        gap = diagnose(load_compiled(arm.path), *recordings)
        self.store.close()
        account.find(sentence(gap))
        account.sections += gap_sections(gap)
        account.summary["gap"] = gap.to_json()
        account.note(bus={key: getattr(bus, key) for key in ("frames", "rate_hz", "load", "missed")})
        account.note(wall_s=time.monotonic() - account.began, sim_s=bench.simulated.time)
        traffic = f"{bus.frames:,} CAN frames in {bench.simulated.time:.0f} s of the arm's time at {bus.rate_hz:.0f} Hz"
        account.find(f"{traffic}, {bus.load:.0%} bus load, {bus.missed} missed")

    def _passes(self) -> list[SweepData]:
        """Without, with and, of drives that warm up, again without the mass, which hangs where the fit is not told."""
        bench, passes = self.bench, list[SweepData]()
        held = "held by their position loops" if sweep_section(bench.arm).hold == "servo" else "pressed on their stops"
        steps = f"sweeping each joint, from tip to base, with the other joints {held}"
        motion = "moving each joint slowly through its range, in both directions" if bench.creeping else steps
        for name in ("unloaded", "loaded", "unloaded-again")[: 3 if bench.creeping else 2]:
            plan, folder = passes[0].plan if passes else None, self.folder / name
            mass = plan.reference_mass if plan is not None and name == "loaded" else 0.0
            if mass:
                bench.simulated.attach_mass(mass)
            load = f"with a reference mass of {mass:g} kg on the hand" if mass else "without a load"
            with self.account.stage(f"{motion}, {load}") as screen:
                if plan is None or mass:
                    made = sweep(bench.link, folder, reference_mass=mass, seed=self.seed, progress=screen.update)
                else:
                    first = {each.joint: each for each in reversed(plan.sweeps)}.values()
                    short = plan.model_copy(update={"sweeps": tuple(each for each in plan.sweeps if each in first)})
                    made = run_sweep(bench.link, bench.arm, folder, progress=screen.update, plan=short)
            if mass:
                bench.simulated.detach_mass()
            notes = made.plan.notes if made.plan is not None and not passes else ()
            for said in (*notes, *(each.reason for each in made.contacts)):
                self.account.say(said)
            passes.append(made)
        return passes

    def _sag(self, plan: SweepPlan, model: str, beta: Array, zero: Array) -> dict[str, Array]:
        self.account.say(f"holding poses with a tenth of the gains and the {model} model", "bold")
        return {model: self.bench.mean_sag(plan, beta, zero)}

    def _verified(self, model: GravityRecord, record: CalibrationRecord, poses: int) -> Verification:
        with self.account.stage("verifying at poses that the fit has not seen") as screen:
            return verify(self.bench.link, model, record, poses=poses, seed=self.seed, progress=screen.count)

    def _recordings(self, record: CalibrationRecord, *seconds: float) -> list[Recording]:
        made = []
        with self.account.stage("recording motion for the gap diagnosis") as screen:
            for number, name in enumerate(("train", "heldout")):
                seed, path = 1000 * (self.seed + 1) + number, self.folder / f"{name}{SUFFIX}"
                made.append(self.bench.record_motion(seconds[number], seed, record, path, screen.count))
        return made

    def _drift(self, record: CalibrationRecord, model: GravityRecord, check: Verification) -> None:
        """Let the arm work, change one sensor, and watch until the observer has put it right or the time is over."""
        bench, link, described, account = self.bench, self.bench.link, self.bench.described, self.account
        section = bench.arm.require_link()
        joint = drifting_joint(record, check, section.rated_torques)
        name, offset = link.names[joint], min(DRIFT_OFFSET, DRIFT_OFFSET_SHARE * section.joints[joint].rated_torque)
        limits = described.lower, described.upper, np.array([each.max_velocity for each in section.joints])
        own_integral = all(setup.gains is None for setup in link.setups)
        # a joint under MIT gains settles later: its host's integral term has to forget the torque of braking
        motion = WorkMotion() if own_integral else WorkMotion(rest=WorkMotion.rest + 0.5)
        targets = work_targets(link.position_sent, *limits, link.period, np.random.default_rng([self.seed, 8]), motion)
        start, began, before = np.nan, np.inf, (0.0, 0.0)

        def course(sample: Sample, history: WatchHistory) -> bool:
            """Make the sensor drift when its time has come; whether the watch is over."""
            nonlocal start, began, before
            start = sample.t if np.isnan(start) else start
            if began == np.inf and sample.t - start >= QUIET_SECONDS:
                began = sample.t
                bench.simulated.drift(joint, DRIFT_GAIN, offset)
                before = bench.sensor_error(joint)
            written = [t for t, _ in history.recalibrations]
            state = "recalibrated" if written else "the arm works" if began == np.inf else "the sensor has drifted"
            screen.count(int(sample.t - start), int(WORK_SECONDS), f"s of work at most, {state}")
            return bool(written) and sample.t - written[-1] >= WATCHED_SECONDS

        observer = observer_of(described, record, model, section.rated_torques)
        recalibrator = Recalibrator(bench.arm, link, self.store)
        with account.stage("ordinary work, during which a torque sensor will drift") as screen:
            history = watch(link, observer, targets, WORK_SECONDS, recalibrator, course)
        # of any joint: which one drifted is found later
        alarm = history.first("alarm", after=began)
        noticed = None if alarm is None else alarm - began
        made = [(t - began, done.record) for t, done in history.recalibrations if done.joint == name]
        written = made[0][0] if made else None
        after, ended = bench.sensor_error(joint), history.t[-1] if written is None else began + written
        seen = "not noticed" if noticed is None else f"noticed after {noticed:.1f} s"
        drifted = f"{name} drifted by {DRIFT_GAIN - 1:+.0%} in gain and {offset:+.2f} N·m in offset: {seen}"
        error = f"the error is now {after[0]:+.2%} and {after[1]:+.2g} N·m"
        if made:
            half = [1.96 * float(made[-1][1].std(of)[joint]) for of in ("gain", "offset")]
            inside = "inside" if np.all(np.abs(after) <= half) else "outside"
            error += f", {inside} its 95 % interval of ±{half[0]:.2%} and ±{half[1]:.2g} N·m"
        if written is None:
            right = f"not recalibrated in {WORK_SECONDS:.0f} s of work ({last_word(history, began)})"
        else:
            right = f"recalibrated automatically after {written:.0f} s of work"
        account.find(f"{drifted}, {right}; {error}")
        truth = np.repeat([(1.0, 0.0), (1.0 + before[0], before[1]), (1.0 + after[0], after[1])], 2, axis=0).T
        marks = [(began, f"drifts, {seen}"), *([] if written is None else [(ended, "recalibrated")])]
        figure = watch_figure(history, joint, ([history.t[0], began, began, ended, ended, history.t[-1]], truth), marks)
        account.sections.append(ReportSection("Drift and automatic recalibration", paragraph(WATCHED), [figure]))
        summary: dict[str, object] = {"joint": name, "gain": DRIFT_GAIN, "offset": offset, "detected_after_s": noticed}
        summary |= {"recalibrated": written is not None, "recalibrated_after_s": written}
        account.note(drift=summary | {"gain_error_after": abs(after[0]), "offset_error_after": abs(after[1])})

    def _tell_sensors(self, passes: list[SweepData], fit: Calibrated, record: CalibrationRecord, truth: Truth) -> None:
        account, true = self.account, {**vars(truth), "coulomb": self.bench.simulated.true_friction}
        names: tuple[Any, ...] = ("gain", "offset", "position_offset" if self.bench.creeping else "position_gain")
        account.note(sensors={name: {"true": true[name], **_estimate(fit, name)} for name in names}, drift=None)
        account.note(not_identifiable={f"{joint}.{name}": why for (joint, name), why in fit.reasons.items()})
        swept = "was swept without and with"
        if isinstance(fit, CreepFit):
            swept = "moved slowly through its range in three passes, without, with and again without"
            friction = {name: _estimate(fit, name) for name in ("coulomb", "load", "viscous", "asymmetry")}
            friction["coulomb"]["true"] = true["coulomb"]
            account.note(friction=friction, disturbed=[each.text for each in fit.findings], sag=None)
            names += ("coulomb", "load", "viscous")
        parts = calibration.sections(calibration.Calibrated(self.bench.arm, passes, fit, record, None))
        columns: dict[str, tuple[Array, Array]] = {}
        for name in names:
            columns[name.replace("_", " ")] = fit.value(name), fit.ci95(name)[:, 1] - fit.value(name)
            if name in true:
                columns["true " + name.replace("_", " ")] = true[name], 0 * true[name]
        table = account.table(
            "torque gain, offset [N·m] and other parameters: estimate ± half of the 95 % interval, and true value",
            fit.names,
            columns,
        )
        text = f"Each joint {swept} a reference mass; the true values were hidden from the fit."
        truths = ReportSection("Sensor calibration and the true values", paragraph(text), (), [table])
        account.sections += [*parts[:1], truths, *parts[1:]]
        error = np.abs(fit.value("gain") / truth.gain - 1)
        unseen = ", ".join(name for name, each in zip(fit.names, error, strict=True) if np.isnan(each))
        known = f"Torque gains found with an error of at most {np.nanmax(error, initial=0.0):.2%}"
        account.find(f"{known}; the gain is not observable on {unseen}" if unseen else known)

    def _tell_gravity(self, check: Verification, errors: dict[str, Any], sags: dict[str, Array]) -> None:
        account, poses, largest = self.account, len(check.position), errors["max_torque"]
        account.note(verify={"poses": poses, "rms": check.rms}, gravity=errors)
        columns = {"RMS to sensor": check.rms, "RMS to truth": errors["rms_error"]}
        columns |= {"largest error": errors["max_abs_error"], "largest torque": largest}
        columns |= {f"sag, {model} model [°]": np.degrees(sag) for model, sag in sags.items()}
        title = (
            f"gravity model [N·m], compared with the sensors at {poses} poses and with the true values at "
            f"{errors['poses']} poses"
        )
        table = account.table(title, check.names, {name: (each, 0 * each) for name, each in columns.items()})
        html = paragraph(f"Torque of model and arm at {poses} poses that were not used for any fit.")
        account.sections.append(ReportSection("Gravity model", html, [verify_figure(check)], [table]))
        share = errors["rms_error"].max() / largest.max()
        account.find(
            f"At every joint, the RMS error of the model's gravity torque is within {share:.2%} of the arm's "
            "largest gravity torque"
        )
        if sags:
            before, after = (np.degrees(sag.max()) for sag in sags.values())
            account.find(
                f"Held with a tenth of the gains, the worst joint sags by {after:.1f}° instead of {before:.1f}°"
            )


def _estimate(fit: Any, name: str) -> dict[str, Any]:
    """Estimates and 95 % intervals, null for a joint without one."""
    return {"estimated": fit.value(name), "ci95": [each if np.isfinite(each[0]) else None for each in fit.ci95(name)]}
