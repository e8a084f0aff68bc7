"""Plausibility gates before a record goes to controllers: bounds, change against history, held-out residual."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.link.torque_sensor_record import GAIN_RANGE
from calib.arm.kinematics import gcomp_arm
from calib.fit.findings import Finding
from calib.fit.sweep_readings import SweepReadings, sweep_readings
from calib.records.records import Array, CalibrationRecord, GravityRecord, Parameter
from calib.records.store import RecordStore
from calib.sweep.dataset import SweepData
from gcomp.errors import GcompError
from gcomp.identify.global_fit import identify_global
from gcomp.identify.parameters import Parameters, Prior
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict

LARGEST_OFFSET = 0.5
"""Offset beyond which a sensor is broken, as a share of rated torque."""
USUAL = {"gain": 0.02, "offset": 0.02}
"""Standard deviation of a change between two calibrations before there is history: of gain as a ratio, of offset as a
share of rated torque."""
USUAL_COUNTS = 4
"""Past changes that the usual one counts for."""
DEVIATIONS = 5.0
"""A change beyond so many standard deviations of covariance and history is refused: 10 % of gain without history."""
NOT_BY_CHANCE = 3.0
"""Standard errors by which the held-out residual must be worse to be called worse."""
WORSE = 1.05
"""Ratio of held-out RMS, new over old, below which it is not worse."""
FEWEST = 6
"""Readings of a joint from which that is judged."""
LOOSE = 0.2
"""Prior of a gain that is estimated anew: it only fixes the scale where no mass does, which no prediction shows."""


def check_gates(
    record: CalibrationRecord,
    arm: ArmFile,
    store: RecordStore,
    data: Sequence[SweepData],
    replaced: Sequence[str] = (),
) -> None:
    """Raise Refused where a record from sweeps may not go to the controllers; `replaced` joints have a new sensor."""
    check_bounds(record, arm)
    old = store.current(CalibrationRecord, arm)
    if old is None or old.id == record.id:
        return
    check_change(record, old, past_changes(store, arm), arm, replaced)
    if not replaced:
        check_heldout(record, old, arm, data, store.current(GravityRecord, arm))


def check_holds(findings: Sequence[Finding], accepted: Sequence[str] = ()) -> None:
    """Raise Refused where the fit says that the sensor model does not hold on a joint that was not `accepted` so."""
    broken = next((each for each in findings if each.breaks_model and each.joint not in accepted), None)
    if broken is not None:
        why = broken.text.removeprefix(f"{broken.joint}: ").rstrip(".")
        raise Refused(
            f"{broken.joint}: the sensor model does not hold: {why}; nothing was written: mend that and sweep again, or"
            f" give --accept {broken.joint}"
        )


def check_bounds(record: CalibrationRecord, arm: ArmFile) -> None:
    """Raise Refused where a gain or an offset is none that a working sensor has."""
    for joint, link in zip(record.joints, arm.require_link().joints, strict=True):
        if joint.gain is not None and not GAIN_RANGE[0] <= joint.gain <= GAIN_RANGE[1]:
            raise Refused(
                f"{joint.name}: gain {joint.gain:.4f} is not between {GAIN_RANGE[0]:g} and {GAIN_RANGE[1]:g}: check the"
                " sensor's wiring and the arm file; nothing was written"
            )
        limit = LARGEST_OFFSET * link.rated_torque
        if joint.offset is not None and abs(joint.offset) > limit:
            raise Refused(
                f"{joint.name}: offset {joint.offset:.3f} N·m is beyond ± {limit:.3f}, half of rated torque: check the"
                " sensor; nothing was written"
            )


def past_changes(store: RecordStore, arm: ArmFile) -> dict[str, Array]:
    """Changes from each calibration in force to the next, (R, n): gain as a ratio, offset in rated torques."""
    rated = np.array([joint.rated_torque for joint in arm.require_link().joints])
    ids = [line.record for line in store.activations(arm) if line.kind == "calibration"]
    records = [store.get(each) for each in ids]
    kept = [each for each in records if isinstance(each, CalibrationRecord)]
    kept = [each for each in kept if each.description_hash == arm.description_hash]
    gain = np.array([each.values("gain") for each in kept]).reshape(-1, len(rated))
    offset = np.array([each.values("offset") for each in kept]).reshape(-1, len(rated))
    return {"gain": gain[1:] / gain[:-1] - 1, "offset": np.diff(offset, axis=0) / rated}


def check_change(
    new: CalibrationRecord, old: CalibrationRecord, past: dict[str, Array], arm: ArmFile, replaced: Sequence[str] = ()
) -> None:
    """Raise Refused where a pair changed by more than both records' covariances and the arm's history allow."""
    rated = np.array([joint.rated_torque for joint in arm.require_link().joints])
    scales = {"gain": np.abs(old.values("gain")), "offset": rated}
    parameters: tuple[Parameter, ...] = ("gain", "offset")
    for parameter in parameters:
        scale = scales[parameter]
        change = (new.values(parameter) - old.values(parameter)) / scale
        spread = np.sqrt(np.nan_to_num(new.std(parameter)) ** 2 + np.nan_to_num(old.std(parameter)) ** 2) / scale
        allowed = DEVIATIONS * np.hypot(spread, history_std(past[parameter], USUAL[parameter]))
        for j, joint in enumerate(new.joints):
            if joint.name not in replaced and abs(change[j]) > allowed[j]:  # NaN, without a value, is not above
                of = "" if parameter == "gain" else " of rated torque"
                raise Refused(
                    f"{joint.name}: {parameter} {new.values(parameter)[j]:.4f} is {change[j]:+.1%}{of} from record"
                    f" {old.id}, covariance and history allow {allowed[j]:.1%}: check the sensor; if it was exchanged:"
                    f" --replaced {joint.name}; nothing was written"
                )


def history_std(past: Array, usual: float) -> Array:
    """Standard deviation (n,) of a joint's change, from its past ones (R, n) and, at first, from what is usual.

    Changes beyond what the usual allows were an exchanged sensor's and count as the largest that it allows.
    """
    known = np.clip(np.nan_to_num(past), -DEVIATIONS * usual, DEVIATIONS * usual)
    counts = USUAL_COUNTS + np.isfinite(past).sum(axis=0)
    std: Array = np.sqrt((USUAL_COUNTS * usual**2 + (known**2).sum(axis=0)) / counts)
    return std


def check_heldout(
    new: CalibrationRecord,
    old: CalibrationRecord,
    arm: ArmFile,
    data: Sequence[SweepData],
    gravity: GravityRecord | None = None,
) -> None:
    """Raise Refused where a joint's readings that were left out of the fit are predicted worse than by the old record.

    Every second step is left out: new gains, offsets and mass moments are estimated without it. The old record's pairs
    are held, and the mass moments of `gravity` with them; without it those are estimated too. Both predict the steps
    left out; then the other half is left out.
    """
    rows = sweep_readings([each.require(arm) for each in data])
    fresh = heldout_scores(new, arm, rows, refit=True)
    beta = None if gravity is None else np.array(gravity.require(arm).beta)
    stale = heldout_scores(old, arm, rows, refit=False, beta=beta)
    for j, joint in enumerate(new.joints):
        ratio = worse_by(fresh[:, j], stale[:, j])
        if ratio is not None:
            raise Refused(
                f"{joint.name}: readings left out of the fit are {ratio:.2f} times as far off with record {new.id} as"
                f" with {old.id}: the sweeps do not agree with one another; nothing was written"
            )


def worse_by(new: Array, old: Array) -> float | None:
    """RMS of new errors (K,) over that of old ones where they are worse beyond chance; else None. NaN is left out."""
    counted = np.isfinite(new) & np.isfinite(old)
    if counted.sum() < FEWEST:
        return None
    difference = new[counted] ** 2 - old[counted] ** 2
    ratio = float(np.sqrt(np.mean(new[counted] ** 2) / max(float(np.mean(old[counted] ** 2)), 1e-300)))
    chance = NOT_BY_CHANCE * float(difference.std(ddof=1)) / np.sqrt(len(difference))
    return ratio if ratio > WORSE and float(difference.mean()) > chance else None


def heldout_scores(
    record: CalibrationRecord, arm: ArmFile, rows: SweepReadings, refit: bool, beta: Array | None = None
) -> Array:
    """Prediction errors (K, n) of steps that were left out, over their standard deviation; NaN where none counts.

    With `refit` gains and offsets are estimated on the other steps, else the record's are held; likewise mass moments
    where `beta` (2n,) is given.
    """
    described, score = gcomp_arm(arm), np.full(rows.readings.torque.shape, np.nan)
    known = {} if beta is None else {"beta": beta}
    start = Parameters.nominal(
        described.n,
        gain=record.values("gain", 1.0),
        offset=record.values("offset", 0.0),
        position_gain=record.values("position_gain", 1.0),
        position_offset=record.values("position_offset", 0.0),
        **known,
    )
    priors = {"gain": Prior(start.gain, LOOSE)} if refit else {}
    fold = _folds(rows)
    unknown = {"rho"} if any(rows.masses) else set[str]()
    unknown |= ({"gain", "offset"} if refit else set()) | ({"beta"} if beta is None else set())
    for left_out in (0, 1):
        kept, complete = rows.readings.rows(fold != left_out), start
        try:
            if unknown:
                complete = identify_global(described, kept, unknown=unknown, start=start, priors=priors).complete
        except GcompError:
            continue
        held: StaticReadings = rows.readings.rows(fold == left_out)
        score[fold == left_out] = (held.torque - predict(described, complete, held)) / held.sigma
    return score


def _folds(rows: SweepReadings) -> npt.NDArray[np.int64]:
    """0 or 1 for every row: the steps of each sweep alternate, both directions of one step together."""
    fold = np.zeros(len(rows.readings), dtype=np.int64)
    for sweep in range(len(rows.sweeps)):
        here = rows.readings.series == sweep
        joint = int(rows.swept[here][0])
        if joint < 0:
            fold[here] = np.arange(here.sum()) % 2
            continue
        steps = rows.readings.position[here, joint]
        gap = max(np.ptp(steps) / max(here.sum(), 1) / 2, 1e-6)
        order = np.argsort(steps)
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.concatenate([[0], np.cumsum(np.diff(steps[order]) > gap)])
        fold[here] = rank % 2
    return fold
