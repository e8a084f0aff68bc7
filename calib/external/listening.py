"""External torque, wrench and contacts, row by row: of recordings, and of samples as they come from a bus.

What was learned of an arm's own work is kept in a file, for as long as the same records are in force.
"""

import io
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armlink.content.atomic_file import write_whole
from armlink.errors import BadInput
from armlink.recording.recording import Recording
from calib.external.arm_model import LONGEST_GAP, ArmListener, ArmRecords, averaged_samples
from gcomp.arrays import Array, joined
from gcomp.external.contact import ContactDetector, ContactEvent, JudgedRows
from gcomp.external.external_model import CHUNK, ExternalModel, Spread
from gcomp.external.filtered_rows import RowFilter, Samples
from gcomp.external.rigid_motion import RigidMotion
from gcomp.external.wrench import Wrench, smallest_force, wrench


@dataclass(frozen=True, eq=False)
class WrenchFrame:
    """Where a wrench is told: a point of a link's bar frame."""

    link: int
    point: Array
    """(3,) [m]."""


@dataclass(frozen=True, eq=False)
class Heard:
    """One stretch of a recording."""

    t: Array
    """(S,) [s]."""
    position: Array
    """(S, n) [rad]."""
    judged: JudgedRows
    wrench: Wrench
    least_force: tuple[Array, Array]
    """Force at the frame that would be found [N], along the direction felt best and the one felt worst (S,)."""
    events: list[ContactEvent]
    load: Array
    """Mass [kg] and first moment [kg·m] that the arm was found to carry at the end (4,)."""


def listen(listener: ArmListener, recording: Recording, frame: WrenchFrame, per_hour: float) -> Iterator[Heard]:
    """Each stretch of a recording without a gap is judged on its own."""
    model = listener.model
    for t, samples in listener.samples(recording):
        made, detector = model.filter(listener.rate), ContactDetector(model, per_hour, frame.point)
        parts, events = [], list[ContactEvent]()
        for begin in range(0, len(samples), CHUNK):
            part = slice(begin, begin + CHUNK)
            filtered = made.rows(samples.part(part))
            rows, when = model.rows(filtered), t[part][filtered.chosen]
            judged, found = detector.judge(when, rows)
            events += found
            motion, spread = filtered.motion, model.lasting
            told = wrench(motion, frame.link, frame.point, judged.external, judged.std, spread.precision)
            least = smallest_force(
                model, detector.sudden_limit, motion, frame.link, frame.point, judged.change_std, model.sudden
            )
            parts.append((when, samples.position[part][filtered.chosen], judged, told, *least))
        times, positions, judgements, wrenches, best, worst = zip(*parts, strict=True)
        yield Heard(
            np.concatenate(times),
            np.concatenate(positions),
            joined(judgements),
            joined(wrenches),
            (np.concatenate(best), np.concatenate(worst)),
            events,
            detector.load,
        )


SCHEMA = "armlink.external-learned/2"
SPREADS, ARRAYS = ("lasting", "sudden"), ("links", "joints", "factors", "scale")
OF_SPREAD = ("weights", "still", "moving", "correlation")


@dataclass(frozen=True, eq=False)
class Learned:
    """All that listening needs."""

    listener: ArmListener
    frame: WrenchFrame
    per_hour: float
    """Allowed rate of false alarms [1/h]."""

    def described(self) -> dict[str, Any]:
        """Its part of every answer."""
        model, frame = self.listener.model, self.frame
        return {
            "joints": list(model.arm.names),
            "channel": self.listener.channel,
            "baseline_s": model.seconds,
            "false_alarms_per_hour": self.per_hour,
            "frame": {"joint": model.arm.names[frame.link], "point": frame.point.tolist()},
        }


def save_learned(path: Path, learned: Learned) -> None:
    """Write it; raises OSError."""
    listener, model = learned.listener, learned.listener.model
    content: dict[str, Any] = {name: getattr(model, name) for name in ARRAYS}
    for spread in SPREADS:
        content |= {f"{spread}_{name}": getattr(getattr(model, spread), name) for name in OF_SPREAD}
    content |= {f"maxima_{k}": each for k, each in enumerate(model.maxima)}
    content["schema"] = SCHEMA
    content |= {"seconds": model.seconds, "channel": listener.channel, "rate": listener.rate}
    content |= {"names": model.arm.names, "records": _ids(listener.records), "per_hour": learned.per_hour}
    content |= {"link": learned.frame.link, "point": learned.frame.point}
    if listener.warm is not None:
        content["warm"] = listener.warm
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **content)
    write_whole(path, stream.getvalue())


def load_learned(path: Path, records: ArmRecords) -> Learned:
    """Raises BadInput where it cannot be read, or was learned of another arm or with other records."""
    arm = records.stated.arm
    try:
        with np.load(path, allow_pickle=False) as file:
            content = dict(file)
        if str(content["schema"]) != SCHEMA:
            raise BadInput(f"{path}: schema is {content['schema']}, expected {SCHEMA}: learn again with --baseline")
        if tuple(content["names"].tolist()) != arm.names or tuple(content["records"].tolist()) != _ids(records):
            raise BadInput(f"{path}: was learned from another arm or other records: learn again with --baseline")
        spreads = [Spread(*(content[f"{spread}_{name}"] for name in OF_SPREAD)) for spread in SPREADS]
        maxima = content["maxima_0"], content["maxima_1"]
        links, joints, factors, scale = (content[name] for name in ARRAYS)
        model = ExternalModel(
            arm, links, joints, factors, spreads[0], spreads[1], maxima, scale, float(content["seconds"])
        )
        listener = ArmListener(model, records, str(content["channel"]), float(content["rate"]), content.get("warm"))
        return Learned(listener, WrenchFrame(int(content["link"]), content["point"]), float(content["per_hour"]))
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError, zipfile.BadZipFile):
        raise BadInput(f"{path}: is not a file that --learned has written: learn again with --baseline") from None


def _ids(records: ArmRecords) -> tuple[str, str]:
    """Of the records in use; empty for none."""
    calibration, gravity = records.calibration, records.gravity
    return "" if calibration is None else calibration.id, "" if gravity is None else gravity.id


@dataclass(frozen=True, eq=False)
class ExternalRow:
    """The newest row."""

    t: float
    """[s]"""
    external: Array
    """(n,) [N·m], with which the surroundings push."""
    std: Array
    """(n,) [N·m]."""
    motion: RigidMotion


MEASURED_SAMPLES = 10
"""From which the time between two of them is taken."""


class LiveExternal:
    """`take` samples as they come; `row` is the newest row, None while there is none.

    Samples of any rate are taken at even times, as those of recordings are.
    """

    def __init__(self, learned: Learned) -> None:
        self.learned = learned
        self.restart()

    def restart(self) -> None:
        """The next samples do not follow from those before."""
        model = self.learned.listener.model
        self._filter: RowFilter = model.filter(self.learned.listener.rate)
        self._detector = ContactDetector(model, self.learned.per_hour, self.learned.frame.point)
        self._taken = np.empty((0, 1 + 3 * model.arm.n))
        """Samples that later values rest on."""
        self._averaged = 0
        """How many samples go into one value; 0 before that is known."""
        self._next = -np.inf
        """Time of the next value [s]."""
        self._last: Array | None = None
        self.row: ExternalRow | None = None

    @property
    def load(self) -> float:
        """Mass that the arm has taken up since the samples began [kg]."""
        return float(self._detector.load[0])

    def take(
        self, t: Array, position: Array, velocity: Array, torque: Array, temperature: Array | None
    ) -> list[ContactEvent]:
        """Samples at times (K,) [s], (K, n) each, and temperatures (n,) [°C]; samples with a NaN are left out."""
        listener = self.learned.listener
        n, rate = listener.model.arm.n, listener.rate
        taken = np.column_stack([t, position, velocity, torque])
        taken = taken[np.isfinite(position).all(1) & np.isfinite(torque).all(1)]
        if not len(taken):
            return []
        before = self._taken[-1, 0] if len(self._taken) else taken[0, 0] - LONGEST_GAP
        steps = np.diff(taken[:, 0], prepend=before)
        parted = np.flatnonzero((steps > LONGEST_GAP) | (steps <= 0.0))
        if len(parted):
            self.restart()
            taken = taken[parted[-1] :]
        values = self._even(taken)
        if not len(values):
            return []
        q, v, torque = values[:, 1 : 1 + n], values[:, 1 + n : 1 + 2 * n], values[:, 1 + 2 * n :]
        if not np.isfinite(v).all():
            first = q[:1] if self._last is None else self._last[None, 1 : 1 + n]
            v = np.diff(q, axis=0, prepend=first) * rate
        self._last = values[-1]
        calibration = listener.records.calibration
        if calibration is not None:
            q, v = calibration.angle(q), v * calibration.values("position_gain", 1.0)
        warmth = np.zeros_like(q)
        if temperature is not None and listener.warm is not None:
            warmth += np.nan_to_num(temperature - listener.warm)
        filtered = self._filter.rows(Samples(q, v, torque, warmth))
        if not len(filtered.by_link):
            return []
        when = values[filtered.chosen, 0]
        judged, events = self._detector.judge(when, listener.model.rows(filtered))
        self.row = ExternalRow(
            float(when[-1]), judged.external[-1], judged.std[-1], filtered.motion.part(slice(-1, None))
        )
        return events

    def _even(self, taken: Array) -> Array:
        """Rows (K, 1 + 3n) at even times, of all samples so far: means over a period where they come faster."""
        period = 1.0 / self.learned.listener.rate
        self._taken = rows = np.concatenate([self._taken, taken])
        if not self._averaged:
            if len(rows) < MEASURED_SAMPLES:
                return rows[:0]
            self._averaged = averaged_samples(rows[:, 0], self.learned.listener.rate)
        if len(rows) <= self._averaged:
            return rows[:0]
        means = rows
        if self._averaged > 1:
            means = np.lib.stride_tricks.sliding_window_view(rows, self._averaged, axis=0).mean(axis=-1)
        self._next = max(self._next, float(means[0, 0]))
        even = np.arange(self._next, means[-1, 0] + 1e-6 * period, period)
        if len(even):
            self._next = float(even[-1]) + period
        self._taken = rows[max(int(np.searchsorted(means[:, 0], self._next)) - 1, 0) :]
        place = np.clip(np.searchsorted(means[:, 0], even, side="right") - 1, 0, len(means) - 2)
        share = (even - means[place, 0]) / (means[place + 1, 0] - means[place, 0])
        return np.asarray(means[place] + share[:, None] * (means[place + 1] - means[place]))

    def wrench(self) -> Wrench | None:
        """Of the newest row at the frame learned for."""
        row, frame = self.row, self.learned.frame
        if row is None:
            return None
        precision = self.learned.listener.model.lasting.precision
        return wrench(row.motion, frame.link, frame.point, row.external[None], row.std[None], precision)
