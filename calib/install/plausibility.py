"""Gates that a calibration record passes before it is written to joint controllers: bounds, change, distance.

Each way to the controllers has its gate: `admit` for a record from sweeps, from slow motion or made current by hand,
`admit_drift` for a recalibration by the observer, `admit_rollback` for a return to an earlier record. Their answer,
`Admitted`, is what `calib.install.journaled_write.install` writes; nothing else makes one.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.link.types import Calibration
from armlink.torque_calibration import GAIN_RANGE, UNKNOWN, TorqueCalibration
from calib.records.records import CalibrationRecord, Parameter
from calib.records.store import RecordStore
from gcomp.arrays import Array

LARGEST_OFFSET = 0.5
"""Largest offset of a working sensor, as a share of rated torque: beyond, half of its range is lost on one side."""
USUAL = {"gain": 0.02, "offset": 0.02}
"""Standard deviation of a change between two calibrations before there is history: gain as a ratio, offset as a share
of rated torque."""
USUAL_COUNTS = 4
"""Number of past changes that USUAL weighs as much as: history dominates from the fifth change on."""
DEVIATIONS = 5.0
"""Largest change in standard deviations of covariance and history; 10 % of gain without history."""
LARGEST_DRIFT = DEVIATIONS * USUAL["gain"]
"""Largest change that is a drift and not a broken or exchanged sensor: of a gain as a ratio, of an offset as a share of
rated torque (docs/theory.md, section 6.6)."""
NOT_BY_CHANCE = 3.0
"""Standard errors by which the held-out error must be larger to be called worse: by chance once in 740."""
WORSE = 1.05
"""Ratio of held-out RMS, new over old, below which it is not worse."""


class Refusal(Enum):
    """Why a gate refuses a record; the value is the message that follows the joint's name."""

    MODEL = "the sensor model does not hold: {why}; correct the cause and sweep again, or give --accept {joint}"
    GAIN = "gain {value:.4f} is not between {lower:g} and {upper:g}: check the sensor's wiring and the arm file"
    OFFSET = "offset {value:.3f} N·m is beyond ± {limit:.3f}, half of rated torque: check the sensor"
    CHANGE = (
        "{parameter} {value:.4f} differs by {change:+.1%}{of} from record {record}, but covariance and "
        "history allow only {limit:.1%}: check the sensor; if it was exchanged, give --replaced {joint}"
    )
    DRIFT = "{difference} away from record {record}, but a drift is at most {limit}: check the sensor, then sweep"
    FAR = (
        "{difference} away from what its drive holds, but a roll-back may change at most {limit}: check the "
        "record; if the sensor was exchanged, give --replaced {joint}"
    )
    HELD_OUT = (
        "the error on held-out data is {ratio:.2f} times the error of record {record}, so the sweeps or "
        "recordings do not agree with one another"
    )


class GateRefused(Refused):
    def __init__(self, refusal: Refusal, joint: str, **values: object) -> None:
        """`values` fill in the refusal's text."""
        super().__init__(f"{joint}: {refusal.value.format(joint=joint, **values)}; nothing was written")
        self.refusal, self.joint = refusal, joint


@dataclass(frozen=True)
class Admitted:
    """A record of an arm that may be written to its controllers, since it passed the gates."""

    record: CalibrationRecord
    arm: ArmFile
    gates: str
    """Which gates it passed, for the journal."""
    before: CalibrationRecord | None = None
    """The record that it replaces; None if there is none or it was installed before itself."""


def admit(
    record: CalibrationRecord,
    arm: ArmFile,
    store: RecordStore,
    replaced: Sequence[str] = (),
    held: Sequence[Calibration] = (),
) -> Admitted:
    """Gate of bounds and of the change from the record that this one replaces; raises GateRefused.

    `replaced` are joints with an exchanged sensor, whose change is not judged; `held` the controllers' calibrations,
    joint by joint, which a record needs that was made current before it was installed.
    """
    check_bounds(record.require(arm), arm)
    before = replaced_record(record, arm, store, held)
    if before is not None:
        check_change(record, before, past_changes(store, arm, until=before.id), arm, replaced)
    return Admitted(record, arm, "bounds and change", before)


def admit_drift(record: CalibrationRecord, reference: CalibrationRecord, j: int, arm: ArmFile) -> Admitted:
    """Gate of a drift: joint j's change from `reference`, the last sweep's record; raises GateRefused."""
    check_bounds(record.require(arm), arm, (j,))
    new, old = record.joints[j].torque_calibration(), reference.joints[j].torque_calibration()
    for difference, limit in _too_far(new, old, float(arm.require_link().rated_torques[j])):
        raise GateRefused(Refusal.DRIFT, record.joints[j].name, difference=difference, limit=limit, record=reference.id)
    return Admitted(record, arm, "bounds and drift", reference)


def admit_rollback(
    record: CalibrationRecord,
    arm: ArmFile,
    store: RecordStore,
    held: Mapping[int, Calibration],
    replaced: Sequence[str] = (),
) -> Admitted:
    """Gate of a roll-back: only the distance from what the controllers of some joints hold; raises GateRefused.

    The calibration from before the last write is never far, and a blank controller has nothing to compare with.
    """
    last, rated = store.last_write(arm), arm.require_link().rated_torques
    entries = [] if last is None else last.body["before"]
    former = {entry["name"]: TorqueCalibration(entry["gain"], entry["offset"]) for entry in entries}
    for j, now in held.items():
        joint, scale = record.require(arm).joints[j], float(rated[j])
        new = joint.torque_calibration(now)
        if joint.name in replaced or now.is_blank or former.get(joint.name, UNKNOWN).matches(new):
            continue
        for difference, limit in _too_far(new, now, scale):
            raise GateRefused(Refusal.FAR, joint.name, difference=difference, limit=limit)
    return Admitted(record, arm, "roll-back: only the distance from the installed calibration was checked")


def _too_far(new: TorqueCalibration[float], old: TorqueCalibration[float], rated: float) -> Iterator[tuple[str, str]]:
    """(Difference, limit) in words for gain and offset [N·m], if further apart than LARGEST_DRIFT; NaN is not."""
    gain, offset = new.gain / old.gain - 1, new.offset - old.offset
    if abs(gain) > LARGEST_DRIFT:
        yield f"gain {new.gain:.4f} is {gain:+.1%}", f"{LARGEST_DRIFT:.0%}"
    if abs(offset) > LARGEST_DRIFT * rated:
        yield f"offset {new.offset:.3f} N·m is {offset:+.3f} N·m", f"{LARGEST_DRIFT * rated:.3f} N·m"


def check_bounds(record: CalibrationRecord, arm: ArmFile, joints: Sequence[int] | None = None) -> None:
    """Raise GateRefused if a gain or an offset of `joints` (default: all) is outside of a working sensor's range."""
    (lower, upper), rated = GAIN_RANGE, arm.require_link().rated_torques
    for j in range(len(record.joints)) if joints is None else joints:
        joint = record.joints[j]
        if joint.gain is not None and not lower <= joint.gain <= upper:
            raise GateRefused(Refusal.GAIN, joint.name, value=joint.gain, lower=lower, upper=upper)
        limit = LARGEST_OFFSET * float(rated[j])
        if joint.offset is not None and abs(joint.offset) > limit:
            raise GateRefused(Refusal.OFFSET, joint.name, value=joint.offset, limit=limit)


def check_held_out(record: CalibrationRecord, before: CalibrationRecord) -> None:
    """Raise GateRefused where the record's proof says that it predicts held-out data worse than the one before.

    Raises Refused where there is no proof, or one against another record.
    """
    proof = record.held_out
    if proof is None or proof.against != before.id:
        raise Refused(f"record {record.id} was not compared with record {before.id} by held-out data: calibrate again")
    for each in proof.joints:
        if each.ratio > WORSE and each.deviations > NOT_BY_CHANCE:
            raise GateRefused(Refusal.HELD_OUT, each.joint, ratio=each.ratio, record=before.id)


def replaced_record(
    record: CalibrationRecord, arm: ArmFile, store: RecordStore, held: Sequence[Calibration] = ()
) -> CalibrationRecord | None:
    """The calibration that a record replaces on the controllers; None if it is the first, or installed already.

    That is the current record. If the record itself was made current first, it is the one installed last, by the
    journal; without a journal the newest earlier one that the controllers hold, else the newest earlier one.
    """
    current = store.current(CalibrationRecord, arm)
    if current is None or current.id != record.id:
        return current
    last = store.last_write(arm)
    if last is not None:
        installed = store.get(last.record)
        same = installed.id == record.id or installed.description_hash != record.description_hash
        return None if same or not isinstance(installed, CalibrationRecord) else installed
    earlier = [each for each in reversed(_calibrations(store, arm)) if each.id != record.id]
    return next((each for each in earlier if held and each.is_installed(held)), earlier[0] if earlier else None)


def _calibrations(store: RecordStore, arm: ArmFile) -> list[CalibrationRecord]:
    """The calibrations that were current on this arm as it is described now, oldest first."""
    ids = [line.record for line in store.activations(arm) if line.kind == "calibration"]
    records = [store.get(each) for each in ids]
    kept = [each for each in records if isinstance(each, CalibrationRecord)]
    return [each for each in kept if each.description_hash == arm.description_hash]


def past_changes(store: RecordStore, arm: ArmFile, until: str | None = None) -> dict[str, Array]:
    """Changes from each current calibration to the next, (R, n): gain as a ratio, offset in rated torques.

    `until` is the id of the last one that counts; default: all.
    """
    rated, kept = arm.require_link().rated_torques, _calibrations(store, arm)
    places = [place for place, each in enumerate(kept) if each.id == until]
    kept = kept[: places[-1] + 1] if places else kept
    gain = np.array([each.values("gain") for each in kept]).reshape(-1, len(rated))
    offset = np.array([each.values("offset") for each in kept]).reshape(-1, len(rated))
    return {"gain": gain[1:] / gain[:-1] - 1, "offset": np.diff(offset, axis=0) / rated}


def check_change(
    new: CalibrationRecord, old: CalibrationRecord, past: dict[str, Array], arm: ArmFile, replaced: Sequence[str] = ()
) -> None:
    """Raise GateRefused if a value changed by more than both records' covariances and the arm's history allow."""
    scales = {"gain": np.abs(old.values("gain")), "offset": arm.require_link().rated_torques}
    parameters: tuple[Parameter, ...] = ("gain", "offset")
    for parameter in parameters:
        scale, values = scales[parameter], new.values(parameter)
        change = (values - old.values(parameter)) / scale
        spread = np.sqrt(np.nan_to_num(new.std(parameter)) ** 2 + np.nan_to_num(old.std(parameter)) ** 2) / scale
        allowed = DEVIATIONS * np.hypot(spread, history_std(past[parameter], USUAL[parameter]))
        for j, joint in enumerate(new.joints):
            if joint.name not in replaced and abs(change[j]) > allowed[j]:  # NaN, without a value, is not above
                raise GateRefused(
                    Refusal.CHANGE,
                    joint.name,
                    parameter=parameter,
                    value=values[j],
                    change=change[j],
                    of="" if parameter == "gain" else " of rated torque",
                    record=old.id,
                    limit=allowed[j],
                )


def history_std(past: Array, usual: float) -> Array:
    """Standard deviation (n,) of a joint's change, from past changes (R, n) and, at first, from the usual one.

    Changes beyond DEVIATIONS times the usual one come from exchanged sensors and are clipped to it.
    """
    known = np.clip(np.nan_to_num(past), -DEVIATIONS * usual, DEVIATIONS * usual)
    counts = USUAL_COUNTS + np.isfinite(past).sum(axis=0)
    return np.asarray(np.sqrt((USUAL_COUNTS * usual**2 + (known**2).sum(axis=0)) / counts))
