"""Wear of a fleet's joints: which parameter of which arm changes, since when, and which arm differs from the others.

A search reports what is large enough to explain the gap, so that a small play is in no answer, and what is near the
threshold comes and goes from day to day. To follow wear, the same effects are fitted every day
(`watched_parameters`), all at once beside the causes found: a change of a tenth of a degree of play is far below what a
single diagnosis would name.

A series is one parameter (friction of joint 2, say) of one arm over its dated diagnoses: those that are watched at
every joint, and those of the causes. Diagnoses of one arm on one motion share their systematic errors, so that a change
is judged by the scatter from one diagnosis to the next and not by the intervals of each.
"""

import re
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from scipy.stats import median_abs_deviation

from gcomp.arrays import Array
from sim_gap.attribution.diagnose import Internals
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.effects.registry import effects
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.term import Term

WATCHED = ("friction.coulomb", "friction.viscous", "torque.gain", "actuator.gain", "transmission.backlash")
"""Effects that are followed. A ripple, whose number of cycles has to be found first, is followed among the causes."""


def watched_parameters(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Watched parameters with 95 % intervals, of each joint that moves in 5 % of the samples; none without a torque
    channel."""
    made = diagnosis.internals
    if not isinstance(made, Internals):
        return []
    signals, places = made.train.signals, {name: effects()[name].signature.places for name in WATCHED}
    moving = sum(each.moving.mean(0) for each in signals) / len(signals)
    main = {"transmission.ripple", *(cause.effect for cause in diagnosis.causes)}.difference(WATCHED)
    kept = [term for term in made.fitted.terms if term.effect in main]
    followed = [Term(name, j) for name in WATCHED for j in places[name](made.train.layout) if moving[j] > 0.05]
    whole = EffectEstimate(made.fitted.store, [*kept, *followed])
    return [
        {
            "effect": term.effect,
            "joint": diagnosis.names[term.place],
            "parameter": name,
            "value": one.value,
            "ci95": [one.low, one.high],
            "unit": one.unit,
        }
        for term in whole.terms
        if term.effect in WATCHED
        for name, one in whole.parameters(term).items()
    ]


FIRST, LAST = 7, 5
"""Number of diagnoses at the start that are the reference, and at the end that are compared with it."""
NEEDED = FIRST + LAST + 1
"""Diagnoses from which on a change can be seen twice running."""
SURE = 5.0
"""Multiple of the difference's standard deviation from which a parameter has changed, in two diagnoses running."""
LEAST = {"friction.coulomb": 0.05, "friction.viscous": 0.05, "torque.gain": 0.005, "actuator.gain": 0.005}
"""Least change by effect, as a share of the reference, 1 % of others: friction varies with temperature, a gain does
not."""
NO_WEAR = frozenset({"cycles", "phase"})
"""Parameters that say where an effect is, and not how large."""
POOLED = 6
"""Weight of the fleet's scatter against an arm's own, as a number of diagnoses."""
ARMS, DIFFERS = 5, 0.25
"""Least number of arms to compare one with, and its least difference from their median, as a share of it."""
HIDDEN = 1.3
"""Multiple of the smallest value reported that a parameter must have had, or have now, to have vanished or appeared:
below, it may be reported on one day and not on the next."""
FOUND = 0.6
"""Share of a window's diagnoses that must have the parameter; it counts as zero if fewer than the rest have it."""
DATE = re.compile(r"(\d{4})-?(\d\d)-?(\d\d)(?:[T_-]?(\d\d):?(\d\d))?")
UNDATED = datetime.min.replace(tzinfo=UTC)

Key = tuple[str, str, str, str]
"""Arm, effect, joint, parameter."""


@dataclass(frozen=True)
class ArmParameter:
    arm: str
    effect: str
    joint: str
    parameter: str
    unit: str


@dataclass(frozen=True)
class Trend(ArmParameter):
    before: float
    now: float
    since: str
    """Date at which the change began, by a line that fits from there on."""
    noticed: str
    """Date of the diagnosis from which it is certain."""


@dataclass(frozen=True)
class Outlier(ArmParameter):
    """One that differs from the same of the other arms."""

    value: float
    others: float
    """Median of all arms."""


@dataclass(frozen=True, eq=False)
class _Series:
    unit: str
    dates: list[datetime]
    values: Array
    """NaN where a diagnosis has not found the parameter, (K,)."""
    interval: Array
    """Half widths of the 95 % intervals of what is watched; NaN otherwise, (K,)."""

    @property
    def watched(self) -> bool:
        """Whether a parameter that is not there is unknown; else it is too small to be found."""
        return bool(np.isfinite(self.interval).any())


def date_of(case: str) -> datetime | None:
    """Date in a case's name (`arm_3/2026-10-02` or `arm_3/20261002T0830`); None without one."""
    for found in reversed(list(DATE.finditer(case))):
        try:
            year, month, day, hour, minute = (int(part or 0) for part in found.groups())
            return datetime(year, month, day, hour, minute, tzinfo=UTC)
        except ValueError:
            continue
    return None


def fleet_trends(answers: Mapping[str, Mapping[str, Any]]) -> list[Trend]:
    """Changes of parameters over the dated cases of each arm (the first folder of a case's name), latest first.

    An arm with a case without a date, or with fewer than NEEDED cases, has none.
    """
    series = _series(answers)
    noise = {key: _scatter(one) for key, one in series.items()}
    pooled: dict[tuple[str, str], list[float]] = defaultdict(list)
    for (_, effect, _, parameter), (own, count, size) in noise.items():
        if count >= FIRST and size > 0.0:
            pooled[effect, parameter].append(own / size)
    found = []
    for key, one in series.items():
        own, count, size = noise[key]
        usual = float(np.median(pooled[key[1], key[3]] or [0.0])) * size
        trend = _trend(key, one, float(np.sqrt((count * own**2 + POOLED * usual**2) / (count + POOLED))))
        if trend is not None:
            found.append(trend)
    return sorted(found, key=lambda trend: trend.noticed, reverse=True)


def needed_recordings(answers: Mapping[str, Mapping[str, Any]]) -> str:
    """Why no change of the arm can be found in these answers yet, in one line; empty if one can."""
    used = [case for case, answer in answers.items() if "error" not in answer]
    undated = sorted(case for case in used if date_of(case) is None)
    if undated:
        return f"{undated[0].partition('/')[2]} has no date in its name, such as 2026-10-02, so no change can be dated"
    return f"at least {NEEDED} recordings are needed to find a change" if len(used) < NEEDED else ""


def fleet_outliers(answers: Mapping[str, Mapping[str, Any]]) -> list[Outlier]:
    """Parameters of one arm that differ from those of the other arms, by the median of its last cases."""
    latest: dict[tuple[str, str, str], dict[str, tuple[float, str]]] = defaultdict(dict)
    for (arm, *which), one in _series(answers, dated=False).items():
        last = one.values[-LAST:]
        if np.isfinite(last).mean() >= FOUND:
            latest[which[0], which[1], which[2]][arm] = float(np.nanmedian(last)), one.unit
    out = []
    for (effect, joint, parameter), arms in latest.items():
        values = np.array([value for value, _ in arms.values()])
        middle = float(np.median(values))
        spread = float(median_abs_deviation(values, scale="normal"))
        for arm, (value, unit) in arms.items() if len(arms) >= ARMS else ():
            if abs(value - middle) > max(SURE * spread, DIFFERS * abs(middle)):
                out.append(Outlier(arm, effect, joint, parameter, unit, value, middle))
    return out


def _series(answers: Mapping[str, Mapping[str, Any]], dated: bool = True) -> dict[Key, _Series]:
    by_arm: dict[str, list[tuple[datetime, Mapping[str, Any]]]] = defaultdict(list)
    for case, answer in sorted(answers.items()):
        if "error" not in answer:
            by_arm[case.split("/")[0]].append((date_of(case) or UNDATED, answer))
    out: dict[Key, _Series] = {}
    for arm, cases in by_arm.items():
        if dated and (len(cases) < NEEDED or any(date is UNDATED for date, _ in cases)):
            continue
        cases.sort(key=lambda pair: pair[0])
        watched = [(date, _watched_values(answer)) for date, answer in cases if dated and answer.get("watched")]
        own = _of_arm(arm, watched) if len(watched) >= NEEDED else {}
        followed = {effect for _, effect, _, _ in own}
        out |= own | _of_arm(arm, [(date, _values(answer, followed)) for date, answer in cases])
    return out


Values = dict[tuple[str, str, str], tuple[float, float, str]]
"""Value, half width and unit of the parameters of an answer, by effect, joint and name."""


def _of_arm(arm: str, answers: Sequence[tuple[datetime, Values]]) -> dict[Key, _Series]:
    dates, out = [date for date, _ in answers], dict[Key, _Series]()
    for k, (_, values) in enumerate(answers):
        for which, (value, half, unit) in values.items():
            if (arm, *which) not in out:
                out[arm, *which] = _Series(unit, dates, *np.full((2, len(dates)), np.nan))
            out[arm, *which].values[k], out[arm, *which].interval[k] = value, half
    for one in out.values():
        if one.watched:  # a joint that hardly moved that day has three times its usual interval
            one.values[one.interval > 3.0 * np.nanmedian(one.interval)] = np.nan
    return out


def _watched_values(answer: Mapping[str, Any]) -> Values:
    found = {}
    for one in answer["watched"]:
        low, high = map(float, one["ci95"])
        found[one["effect"], one["joint"], one["parameter"]] = float(one["value"]), 0.5 * (high - low), one["unit"]
    return found


def _values(answer: Mapping[str, Any], leave: Collection[str]) -> Values:
    return {
        (cause["effect"], joint, name): (float(one["value"]), float("nan"), one["unit"])
        for cause in (*answer.get("causes", ()), *answer.get("minor", ()))
        if not cause["effect"].startswith("law.") and cause["effect"] not in leave
        for joint, parameters in cause["parameters"].items()
        for name, one in parameters.items()
        if name not in NO_WEAR and one["value"] is not None
    }


def _scatter(one: _Series) -> tuple[float, int, float]:
    """Standard deviation from one diagnosis to the next, the number of differences behind it, and what it is in
    proportion to over the fleet: the interval of what is watched, which wear does not change; else the usual size."""
    there = one.values[np.isfinite(one.values)]
    size = float(np.nanmedian(one.interval if one.watched else np.abs(one.values)))
    steps = np.diff(there)
    if len(steps) < 2:
        return 0.0, 0, size
    return float(median_abs_deviation(steps, scale="normal") / np.sqrt(2.0)), len(steps), size


def _window(one: _Series, part: slice) -> float:
    """Mean of the diagnoses that have the parameter; zero if nearly none has it, NaN if it comes and goes."""
    values = one.values[part]
    share = float(np.isfinite(values).mean())
    if share >= FOUND:
        return float(np.nanmean(values))
    return 0.0 if share <= 1.0 - FOUND and not one.watched else float("nan")


def _trend(key: Key, one: _Series, noise: float) -> Trend | None:
    start = _window(one, slice(FIRST))
    seen = 0.05 * float(np.nanmedian(one.interval)) if one.watched else 0.0  # in half widths of its interval
    share = LEAST.get(key[1], 0.01)
    least = max(SURE * noise * float(np.sqrt(1.0 / FIRST + 1.0 / LAST)), share * abs(start), seen, 1e-12)
    hidden = HIDDEN * float(np.nanmin(np.abs(one.values)))
    running = 0
    for k in range(FIRST + LAST - 1, len(one.values)):
        now = _window(one, slice(k - LAST + 1, k + 1))
        needed = max(least, hidden) if start == 0.0 or now == 0.0 else least
        running = running + 1 if abs(now - start) > needed else 0
        if running == 2:
            since = one.dates[_began(one, start, k)].date().isoformat()
            now = _window(one, slice(-LAST, None))
            return Trend(*key, one.unit, start, now, since, one.dates[k].date().isoformat())
    return None


def _began(one: _Series, start: float, noticed: int) -> int:
    """Index of the diagnosis from which a line away from a constant fits best, up to the one that notices."""
    values = np.nan_to_num(one.values) if start == 0.0 else one.values
    there = np.flatnonzero(np.isfinite(values[: noticed + FIRST + LAST]))
    days = np.array([(date - one.dates[0]).total_seconds() / 86400.0 for date in one.dates])[there]
    left = []
    for k in there[there < noticed]:
        x = np.column_stack([np.ones_like(days), np.maximum(days - days[there == k], 0.0)])
        coefficients = np.linalg.lstsq(x, values[there], rcond=None)[0]
        left.append((float(np.sum((values[there] - x @ coefficients) ** 2)), int(k)))
    return min(left)[1]
