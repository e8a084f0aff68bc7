"""The procedure for programs and notebooks: sweep, calibrate, identify, verify, observe. `import armlink` offers it.

Arms and data are given as objects or as paths; every function raises armlink.ArmlinkError with one line that says what
is wrong and how to put it right.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias, TypeGuard, TypeVar

from armlink.arm_file import SIMULATED, ArmFile, Bus, load_arm
from armlink.errors import BadInput
from armlink.loop.open import ArmDriver, open_arm
from armlink.recording.files import load_recording
from armlink.recording.recording import Recording
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import sweep_motion
from calib.commissioning.model_checks import refuse_impossible_sweep
from calib.dataset import SweepData, all_creep, data_sets
from calib.fit.creep_fit import CreepFit, fit_creep
from calib.fit.gravity_fit import GravityFit, identify_gravity
from calib.fit.sensor_fit import SensorFit, fit_sensors
from calib.observer.config import ObserverConfig
from calib.observer.decision import Event
from calib.observer.observer import observer_of
from calib.records.records import CalibrationRecord, GravityRecord
from calib.sweep.run import run_sweep
from calib.sweep.sweep_pass import Progress
from calib.sweep.verify import Verification, run_verify
from gcomp.arrays import Array

T = TypeVar("T")
ArmLike: TypeAlias = ArmFile | str | Path
"""An arm file: loaded, its path, or the name of a bundled arm."""
SweepLike: TypeAlias = SweepData | str | Path
"""The data set of a pass of sweeps: loaded, or its folder."""
Calibrated: TypeAlias = SensorFit | CreepFit
"""Result of `calibrate`: from steps at rest, or from creep sweeps of drives whose torque is a motor current."""


@dataclass(frozen=True, eq=False)
class Observation:
    """Findings of the observer in a recording."""

    names: tuple[str, ...]
    """Joints, base to tip."""
    events: list[Event]
    """Alarms and findings in the order of time."""
    gain: Array
    """Gain of each torque sensor against the calibration at the end (n,); 1 for no change."""
    gain_std: Array
    """(n,)"""
    offset: Array
    """Offset likewise (n,) [N·m]."""
    offset_std: Array
    """(n,) [N·m]"""
    rests: int
    """Rests of the arm that the estimate is made of."""


def open_link(arm: ArmLike, bus: str | None = None, *, simulated: bool = False, load: float = 0.0) -> ArmDriver:
    """Open the link to an arm's joint controllers; use it in a `with` block, which leaves the joints holding.

    Args:
        arm: arm file, its path, or a bundled arm's name.
        bus: INTERFACE:CHANNEL[@BITRATE] instead of the arm file's.
        simulated: the simulated arm of the arm file's `sim` section, in this process, instead of a bus.
        load: mass at the simulated arm's tip [kg].

    Nothing moves before `start()` and `enable()`. Raises BadInput, BusFault.
    """
    arm_file = _arm(arm)
    if not simulated:
        if load:
            raise BadInput(f"open_link: load is {load:g} kg, but only a simulated arm can be given a load")
        return open_arm(arm_file, bus)
    if bus is not None:
        raise BadInput(f"open_link: bus is {bus}, but a simulated arm needs no bus: leave out `bus` or `simulated`")
    own = Bus(interface=SIMULATED, channel=str(arm_file.path), options={"load": load})
    link = arm_file.require_link().model_copy(update={"bus": own, "buses": {}})
    return open_arm(arm_file.model_copy(update={"link": link}))


def sweep(
    arm: ArmLike | ArmDriver,
    out: str | Path,
    *,
    bus: str | None = None,
    simulated: bool = False,
    reference_mass: float = 0.0,
    resume: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> SweepData:
    """Sweep every joint, tip to base, into the folder `out`. **The arm moves through its whole range.**

    Args:
        arm: arm file, its path, or a bundled arm's name; or its link, enabled, which stays open.
        out: folder for the data set; each reading is on disk before the next is made.
        bus: INTERFACE:CHANNEL[@BITRATE] instead of the arm file's.
        simulated: sweep the simulated arm of the arm file's `sim` section.
        reference_mass: mass attached to the flange [kg]; the simulated arm is given it.
        resume: go on after the last reading in `out`.
        seed: of the plan's search.
        progress: called with (readings done, readings in all, seconds left, what is being done).

    Raises BadInput, Refused where the arm cannot be swept or `reference_mass` not be held, BusFault.
    """
    arm_file = arm.arm if _is_link(arm) else _arm(arm)
    refuse_impossible_sweep(arm_file, reference_mass)
    with _enabled(arm, bus, simulated, reference_mass if simulated else 0.0) as link:
        return run_sweep(
            link,
            arm_file,
            Path(out),
            reference_mass=reference_mass,
            resume=resume,
            seed=seed,
            progress=progress,
            bus=bus,
        )


def calibrate(*sweeps: SweepLike, arm: ArmLike | None = None) -> Calibrated:
    """Gains and offsets of all torque and position sensors, with intervals, from passes of sweeps.

    Args:
        sweeps: data sets of `sweep`, or their folders; one pass without and one with a reference mass. Of an arm
            without torque sensors one more pass without, after it.
        arm: the arm file, if it is no longer where the sweeps found it.

    From creep sweeps the result has friction too: `value("coulomb")`, `value("load")`, `value("viscous")`.

    Nothing is stored or written to controllers: `record(arm)` of the result makes a record, `armlink calibrate --apply`
    writes one. Raises BadInput, Refused.
    """
    data = _sweeps("calibrate", sweeps)
    return calibrated(_arm_of(data, arm), data)


def identify(*sweeps: SweepLike, arm: ArmLike | None = None, sensors: Calibrated | None = None) -> GravityFit:
    """The mass moments of the arm's gravity model, with intervals, from the same sweeps.

    Args:
        sweeps: data sets of `sweep`, or their folders.
        arm: the arm file, if it is no longer where the sweeps found it.
        sensors: what `calibrate` found in these sweeps; by default it is called here.

    Raises BadInput, Refused.
    """
    data = _sweeps("identify", sweeps)
    arm_file = _arm_of(data, arm)
    return identified(arm_file, data, sensors or calibrated(arm_file, data))


def verify(
    arm: ArmLike | ArmDriver,
    gravity: GravityFit | GravityRecord,
    sensors: Calibrated | CalibrationRecord | None = None,
    *,
    bus: str | None = None,
    simulated: bool = False,
    poses: int = 24,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Verification:
    """Compare model and sensors at random poses that no fit has seen. **The arm moves through its whole range.**

    Args:
        arm: arm file, its path, or a bundled arm's name; or its link, enabled, which stays open.
        gravity: what `identify` found, or a gravity record.
        sensors: what `calibrate` found, or a calibration record; by default what the controllers hold. Arms without
            torque sensors need it.
        bus: INTERFACE:CHANNEL[@BITRATE] instead of the arm file's.
        simulated: the simulated arm of the arm file's `sim` section.
        poses: how many.
        seed: draws other poses.
        progress: called with (poses done, poses in all).

    Raises BadInput, Refused, BusFault.
    """
    arm_file = arm.arm if _is_link(arm) else _arm(arm)
    calibration = sensors.record(arm_file) if isinstance(sensors, SensorFit | CreepFit) else sensors
    model = gravity.record(arm_file, calibration) if isinstance(gravity, GravityFit) else gravity
    if calibration is None and sweep_motion(arm_file) == "creep":
        raise BadInput("verify: the drives of this arm store no calibration: give what calibrate found as `sensors`")
    with _enabled(arm, bus, simulated) as link:
        return run_verify(link, arm_file, model, calibration, poses=poses, seed=seed, progress=progress)


def observe(
    arm: ArmLike,
    recording: Recording | str | Path,
    gravity: GravityFit | GravityRecord,
    sensors: Calibrated | CalibrationRecord,
    *,
    config: ObserverConfig | None = None,
) -> Observation:
    """Whether a torque sensor drifted while the arm worked: alarms, findings, and the estimate at the end.

    Args:
        arm: arm file, its path, or a bundled arm's name.
        recording: ordinary work with rests, with torque sensor readings as the calibrated controllers send them.
        gravity: what `identify` found, or a gravity record.
        sensors: what `calibrate` found, or a calibration record.
        config: settings of the observer at rest; that of motion (motor currents) has none.

    Raises BadInput where the recording is of another arm or has no torque sensor readings.
    """
    arm_file, run = _arm(arm), _recording(recording)
    if run.torque is None:
        raise BadInput("observe: the recording has no torque sensor readings (tau_1 …)")
    names = arm_file.joint_names or gcomp_arm(arm_file).names
    if run.n != len(names):
        raise BadInput(f"observe: the recording has {run.n} joints, but {arm_file.name} has {len(names)}")
    calibration = sensors.record(arm_file) if isinstance(sensors, SensorFit | CreepFit) else sensors.require(arm_file)
    model = gravity.record(arm_file, calibration) if isinstance(gravity, GravityFit) else gravity.carrying(arm_file)
    rated = arm_file.require_link().rated_torques
    observer = observer_of(gcomp_arm(arm_file), calibration, model, rated, config)
    events: list[Event] = []
    for t, position, torque in zip(run.t, run.position, run.torque, strict=True):
        events += observer.handle(float(t), position, torque)
    found = observer.estimate()
    return Observation(names, events, found.gain, found.gain_std, found.offset, found.offset_std, observer.rows)


def _is_link(arm: object) -> TypeGuard[ArmDriver]:
    return isinstance(getattr(arm, "arm", None), ArmFile)


@contextmanager
def _enabled(arm: ArmLike | ArmDriver, bus: str | None, simulated: bool, load: float = 0.0) -> Iterator[ArmDriver]:
    """The link to the arm: the one given, or one that is opened, started and enabled for this."""
    if not _is_link(arm):
        with open_link(_arm(arm), bus, simulated=simulated, load=load) as link:
            link.start()
            link.enable()
            yield link
    elif bus is not None or simulated:
        raise BadInput("the given link is already open: leave out `bus` and `simulated`")
    else:
        yield arm


def _loaded(given: object, kind: type[T], load: Callable[[str | Path], T], expected: str) -> T:
    """`given`, or what lies at the path that it is."""
    if isinstance(given, kind):
        return given
    if isinstance(given, str | Path):
        return load(given)
    raise BadInput(f"{expected}, not {type(given).__name__}")


def _arm(arm: object) -> ArmFile:
    return _loaded(arm, ArmFile, load_arm, "arm: expected an ArmFile, a path, or the name of a bundled arm")


def _sweeps(function: str, sweeps: tuple[object, ...]) -> list[SweepData]:
    if not sweeps:
        raise BadInput(f"{function}: give at least one data set that `sweep` wrote (SweepData, or its folder)")
    given: list[Path | SweepData] = []
    for each in sweeps:
        if not isinstance(each, SweepData | str | Path):
            kind = type(each).__name__
            raise BadInput(
                f"{function}: expected data sets of sweep or their folders, each as a separate argument, not {kind}"
            )
        given.append(Path(each) if isinstance(each, str) else each)
    return data_sets(given)


def calibrated(arm_file: ArmFile, data: list[SweepData]) -> Calibrated:
    """The fit of data sets, by their motion; raises BadInput, Refused."""
    if all_creep(data):
        return fit_creep(arm_file, data)
    return fit_sensors(arm_file, data)


def identified(arm_file: ArmFile, data: list[SweepData], sensors: Calibrated | CalibrationRecord) -> GravityFit:
    """Mass moments from data sets and their sensors, by their motion; raises BadInput, Refused."""
    if isinstance(sensors, CreepFit if not all_creep(data) else SensorFit):
        raise BadInput(
            "identify: `sensors` come from sweeps of the other kind (creep or steps): leave this argument out"
        )
    return sensors.gravity if isinstance(sensors, CreepFit) else identify_gravity(arm_file, data, sensors)


def _arm_of(data: list[SweepData], arm: ArmLike | None) -> ArmFile:
    return data[0].load_arm(None) if arm is None else _arm(arm)


def _recording(recording: object) -> Recording:
    return _loaded(recording, Recording, load_recording, "recording: expected a Recording or the path of one")
