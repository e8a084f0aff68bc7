"""External torque, wrench and contacts of recordings, row by row."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from armlink.recording.recording import Recording
from calib.external.arm_model import ArmListener
from gcomp.arrays import Array, joined
from gcomp.external.contact import ContactDetector, ContactEvent, JudgedRows
from gcomp.external.external_model import CHUNK
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
