"""Watches an arm at work: samples to the observer, findings to recalibration, estimates to a report."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from armlink.errors import Refused
from armlink.link.types import Command, Sample
from armlink.loop.open import ArmDriver
from calib.observer.decision import Event
from calib.observer.observer import Observer
from calib.observer.recalibrator import Recalibration, Recalibrator
from gcomp.arrays import Array


@dataclass
class WatchHistory:
    """Estimates once per row, and all events, for reports. Times by the samples' clock [s]."""

    t: list[float] = field(default_factory=list)
    gain: list[Array] = field(default_factory=list)
    """Gain (n,) against the calibration installed at that time."""
    gain_std: list[Array] = field(default_factory=list)
    offset: list[Array] = field(default_factory=list)
    """Likewise (n,) [N·m]."""
    offset_std: list[Array] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    recalibrations: list[tuple[float, Recalibration]] = field(default_factory=list)

    def first(self, kind: str, after: float = 0.0) -> float | None:
        """Time of the first event of a kind from `after` on; None if there was none."""
        return next((event.t for event in self.events if event.kind == kind and event.t >= after), None)


def watch(
    link: ArmDriver,
    observer: Observer,
    targets: Iterable[Array],
    seconds: float,
    recalibrator: Recalibrator | None = None,
    on_sample: Callable[[Sample, WatchHistory], bool] | None = None,
) -> WatchHistory:
    """Run the arm along position targets (n,) [rad], one per cycle, for `seconds` of its clock, and observe.

    The recalibrator writes what is found, and the observer takes it as installed; without one nothing is written.
    `on_sample` sees each sample and ends the watch by returning True. Raises BusFault.
    """
    history, end = WatchHistory(), None
    for target in targets:
        sample = link.cycle(Command.hold(target))
        end = sample.t + seconds if end is None else end
        rows = observer.rows
        events = observer.handle(sample.t, sample.position, sample.torque)
        for event in events:
            history.events.append(event)
            if event.finding is not None and recalibrator is not None:
                _recalibrate(event, observer, recalibrator, history)
        if recalibrator is not None:
            _check(sample, observer, recalibrator, history)
        if observer.rows > rows:
            _keep(sample.t, observer, history)
        if sample.t >= end or (on_sample is not None and on_sample(sample, history)):
            break
    return history


def _recalibrate(event: Event, observer: Observer, recalibrator: Recalibrator, history: WatchHistory) -> None:
    assert event.finding is not None
    try:
        outcome = recalibrator.recalibrate(event.finding)
    except Refused as error:
        history.events.append(Event(event.t, "refused", event.joint, {"reason": str(error)}))
        return
    history.recalibrations.append((event.t, outcome))
    evidence = {"record": outcome.record.id, "gain": outcome.gain, "offset": outcome.offset}
    history.events.append(Event(event.t, "recalibration", event.joint, evidence))
    observer.install(event.finding)


def _check(sample: Sample, observer: Observer, recalibrator: Recalibrator, history: WatchHistory) -> None:
    """After a recalibration: take it back if it made the readings worse."""
    checked = recalibrator.sample(sample.t, sample.position, sample.torque)
    if checked is None or checked.verdict == "kept":
        return
    outcome = recalibrator.undo(checked)
    history.events.append(
        Event(sample.t, "roll-back", outcome.joint, {"record": outcome.record.id, "why": checked.why})
    )
    if outcome.undo is not None:
        observer.install(outcome.undo)


def _keep(t: float, observer: Observer, history: WatchHistory) -> None:
    estimate = observer.estimate()
    history.t.append(t)
    for name in ("gain", "gain_std", "offset", "offset_std"):
        getattr(history, name).append(getattr(estimate, name))
