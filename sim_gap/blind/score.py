"""The score of blind checks (docs/formats.md): answers are judged by their labels, then counted. Pure functions."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

CONFIDENT = 0.8
"""Confidence above which a cause counts as blamed."""
BESIDE_POINT = ("phase", "rest", "source", "other_joint")
"""Parameters that are indices or depend on another one."""
SCHEMA = "armlink.blind/1"
POSITIONS_SCHEMA = "armlink.blind-positions/1"
NAMED_SHARE, FALSE_SHARE = 0.85, 0.03
"""Of positions alone: required share of first causes that are right or named as confounded, and of answers with a false
cause above 0.8."""
Json = Mapping[str, Any]
Answers = Mapping[str, Json]
"""Answers or labels by name."""
BINS = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0)
WITHHELD = "--without--"
"""Separator of case and effect removed from the library, in an answer's name."""


@dataclass(frozen=True)
class ParameterError:
    """One estimated parameter: relative error, and whether the 95 % interval contains the true value (None without)."""

    effect: str
    name: str
    relative: float
    inside: bool | None


@dataclass(frozen=True)
class Judgement:
    case: str
    kind: str
    truth: tuple[str, ...]
    withheld: str
    """The effect removed from the library, or empty."""
    verdict: str
    first: str
    """First effect named, effects implied by a true one skipped; empty if none is named."""
    confidence: float
    first_right: bool
    named: bool
    """Whether a true effect is the first or among those confounded with it."""
    tellable: bool
    all_found: bool
    """Whether all true effects are among the causes."""
    blamed: tuple[str, ...]
    """Confident causes that this arm does not have (small true imperfections listed last are excused)."""
    joints: tuple[int, int, int] = (0, 0, 0)
    """Numbers of joints that are right, wrong and missed."""
    errors: tuple[ParameterError, ...] = ()
    shrink: float = float("nan")
    """Claimed relative decrease of the held-out gap at the joint concerned."""
    shrink_true: float = float("nan")
    """Relative decrease of the held-out gap by the true effects."""
    placed: tuple[bool, ...] = ()
    """Of several effects, of each that alone at least doubles the gap of the sound arm somewhere: whether a cause names
    it at one of its true joints."""
    confident: int = 0
    """Number of causes with a confidence above CONFIDENT."""


def judge(answer: Json, label: Json, withheld: str = "") -> Judgement:
    """Judge an answer (docs/formats.md) against its label; `withheld` is the effect that was not in the library."""
    truths = [t for t in label["effects"] if t["effect"] != withheld]
    names = {t["effect"] for t in truths}
    implied = {name for t in label["effects"] for name in t["implied"]}
    causes = list(answer["causes"])
    leading = [c for c in causes if c["effect"] in names or c["effect"] not in implied] or causes
    first = leading[0] if leading else None
    offered = {first["effect"], *(first["confounded_with"] or ())} if first else set()
    shrink, shrink_true = _shrinks(answer, label)
    return Judgement(
        case=label["case"],
        kind=label["kind"],
        truth=tuple(t["effect"] for t in label["effects"]),
        withheld=withheld,
        verdict=answer["verdict"],
        first=first["effect"] if first else "",
        confidence=float(first["confidence"]) if first else 0.0,
        first_right=bool(first and first["effect"] in names),
        named=bool(offered & names),
        tellable=bool(truths) and not any(t["undecided"] for t in truths),
        all_found={t["effect"] for t in label["effects"]} <= names & {c["effect"] for c in causes},
        blamed=_blamed(causes, label, truths, implied),
        joints=_joints(causes, truths),
        errors=tuple(error for t in truths for error in _parameter_errors(causes, t)),
        shrink=shrink,
        shrink_true=shrink_true,
        placed=_placed(causes, label, truths),
        confident=sum(c["confidence"] > CONFIDENT for c in causes),
    )


def _placed(causes: Sequence[Json], label: Json, truths: Sequence[Json]) -> tuple[bool, ...]:
    if label["kind"] != "several":
        return ()
    falls = zip(label["effects"], label["gap"]["falls"], strict=True)
    clear = [t for t, fall in falls if t in truths and fall["before"] > 2.0 * fall["after"]]
    places = [[set(c["joints"]) for c in causes if c["effect"] == t["effect"]] for t in clear]
    return tuple(
        any(not t["joints"] or set(t["joints"]) & joints for joints in named)
        for t, named in zip(clear, places, strict=True)
    )


def _blamed(causes: Sequence[Json], label: Json, truths: Sequence[Json], implied: set[str]) -> tuple[str, ...]:
    """Confident causes that are not true.

    Excused: effects implied by a true one, rivals of an effect that this motion cannot separate, and causes that follow
    every true effect and lower the gap by no more than this arm's small errors do at the same joints.
    """
    due = {t["effect"] for t in truths}
    fine = implied | due | {name for t in truths if t["undecided"] for name in t["confused_with"]}
    out = []
    for cause in causes:
        due.discard(cause["effect"])
        if cause["effect"] in fine or cause["confidence"] <= CONFIDENT:
            continue
        places = [int(joint.removeprefix("joint_")) - 1 for joint in cause["joints"]]
        small = max((rms[j] for rms in label["gap"]["without"].values() for j in places), default=0.0)
        if not due and float(cause["gap_before"] or 0.0) - float(cause["gap_after"] or 0.0) <= small:
            continue
        out.append(str(cause["effect"]))
    return tuple(out)


def _joints(causes: Sequence[Json], truths: Sequence[Json]) -> tuple[int, int, int]:
    """Joints right, wrong and missed, over the true effects of joints: of the cause that names the effect or is
    confounded with it; without one, all are missed."""
    right = wrong = missed = 0
    for truth in truths:
        if not truth["joints"]:
            continue
        effect, true = truth["effect"], set(truth["joints"])
        telling = [c for c in causes if c["effect"] == effect]
        telling += [c for c in causes if effect in (c["confounded_with"] or ())]
        claimed = set(_main_joints(telling[0])) if telling else set[str]()
        right, wrong, missed = right + len(claimed & true), wrong + len(claimed - true), missed + len(true - claimed)
    return right, wrong, missed


def _main_joints(cause: Json) -> list[str]:
    """Joints of a cause whose largest parameter (a gain's distance from 1) is 15 % of that of any joint or more."""
    sizes = {}
    for joint in cause["joints"]:
        values = cause["parameters"].get(joint) or {}
        numbers = [
            _deviation(n, p["value"]) for n, p in values.items() if n not in BESIDE_POINT and p["value"] is not None
        ]
        sizes[joint] = max((abs(x) for x in numbers), default=np.inf)
    limit = 0.15 * max(sizes.values(), default=0.0)
    return [joint for joint, size in sizes.items() if size >= limit or np.isinf(size)]


def _deviation(name: str, value: float) -> float:
    return value - 1.0 if name == "gain" else value


def _parameter_errors(causes: Sequence[Json], truth: Json) -> list[ParameterError]:
    """Relative errors of a true effect's parameters: vectors by their norm, an inertia about the joint's axis."""
    claimed = next((c for c in causes if c["effect"] == truth["effect"]), None)
    out: list[ParameterError] = []
    for joint, true in truth["parameters"].items():
        given = (claimed["parameters"].get(joint) if claimed else None) or {}
        values = {name: p["value"] for name, p in given.items() if name in true and p["value"] is not None}
        if not values:
            continue
        if truth["effect"] in ("link.mass_moment", "link.inertia", "base.tilt"):
            out += _vector_error(truth, true, values)
            continue
        names = [n for n in true if n in values and n not in BESIDE_POINT]
        if truth["effect"] == "link.payload":
            names = ["mass"]
        for name in names:
            size = abs(_deviation(name, true[name]))
            low_high = given[name].get("ci95") or (None, None)
            inside = None if None in low_high else bool(low_high[0] <= true[name] <= low_high[1])
            out.append(ParameterError(truth["effect"], name, abs(values[name] - true[name]) / max(size, 1e-9), inside))
    return out


def _vector_error(truth: Json, true: Json, values: Json) -> list[ParameterError]:
    if truth["effect"] == "link.inertia":
        name, axis = "about_axis", np.array(truth["axis"])
        part = dict(zip("xyz", axis, strict=True))
        weight = {r + c: (1 if r == c else 2) * part[r] * part[c] for r in "xyz" for c in "xyz" if r <= c}
        ours, theirs = (sum(weight[k] * float(source.get(k, 0.0)) for k in weight) for source in (true, values))
        return [ParameterError(truth["effect"], name, abs(theirs - ours) / abs(ours), None)]
    keys = [key for key in true if key in values]
    ours, theirs = np.array([true[k] for k in keys]), np.array([values[k] for k in keys])
    return [
        ParameterError(truth["effect"], "vector", float(np.linalg.norm(theirs - ours) / np.linalg.norm(ours)), None)
    ]


def _shrinks(answer: Json, label: Json) -> tuple[float, float]:
    """Relative decrease of the held-out gap at the joint that the first true effect affects most: claimed and true."""
    falls = label["gap"]["falls"]
    if not falls:
        return float("nan"), float("nan")
    joint, channel = int(falls[0]["joint"].removeprefix("joint_")) - 1, falls[0]["channel"]
    held = answer["gap"]["heldout"]
    before, after = (held[key][joint] if joint < len(held[key]) else None for key in ("before", "after"))
    true = 1.0 - label["gap"]["without"][channel][joint] / label["gap"]["with"][channel][joint]
    return (1.0 - after / before if before and after is not None else float("nan")), true


# ---- all answers


def score(answers: Answers, labels: Answers) -> dict[str, Any]:
    """Score all answers (by name, see `answer_name`) against the labels (by case)."""
    judged = judge_all(answers, labels)
    whole = [j for j in judged if not j.withheld]
    hidden, less = label_withheld(whole), effect_withheld([j for j in judged if j.withheld])
    met = {"label_withheld": hidden, "effect_withheld": less, "meets": meets_bounds(hidden, less)}
    return {"schema": SCHEMA, **met, "calibration": calibration(whole), **_tables(judged)}


def score_positions(answers: Answers, labels: Answers) -> dict[str, Any]:
    """Score the answers of positions alone, as `score` does; shares over no case are None."""
    judged = judge_all(answers, labels)
    whole = [j for j in judged if not j.withheld]
    told = [j for j in whole if j.tellable and j.kind == "single"]
    named, false = share([j.named for j in told]), share([bool(j.blamed) for j in judged])
    met = {
        "named_where_tellable": named is not None and named >= NAMED_SHARE,
        "false_confident": false is not None and false <= FALSE_SHARE,
    }
    shares = {"tellable": len(told), "named_where_tellable": named, "false_confident": false, "meets": met}
    parts = {"answers": len(judged), **shares, "label_withheld": label_withheld(whole)}
    return {"schema": POSITIONS_SCHEMA, **parts, "calibration": calibration(judged), **_tables(judged)}


def judge_all(answers: Answers, labels: Answers) -> list[Judgement]:
    named = [(*name.partition(WITHHELD)[::2], answer) for name, answer in answers.items()]
    return [judge(answer, labels[case], withheld) for case, withheld, answer in named]


def _tables(judged: Sequence[Judgement]) -> dict[str, Any]:
    whole = [j for j in judged if not j.withheld]
    return {"confusion": confusion(whole), "by_effect": by_effect(whole), "cases": [case_row(j) for j in judged]}


def answer_name(case: str, withheld: str = "") -> str:
    return f"{case}{WITHHELD}{withheld}" if withheld else case


def label_withheld(judged: Sequence[Judgement]) -> dict[str, Any]:
    """Shares over the cases with hidden labels: with one effect, with none, with two."""
    some = [j for j in judged if j.kind != "none"]
    single, two, none = ([j for j in judged if j.kind == kind] for kind in ("single", "two", "none"))
    errors = [e.relative for j in some for e in j.errors]
    inside = [e.inside for j in some for e in j.errors if e.inside is not None]
    right, wrong, missed = (sum(j.joints[k] for j in some) for k in range(3))
    precision, recall = _ratio(right, right + wrong), _ratio(right, right + missed)
    f1 = 2 * precision * recall / (precision + recall) if precision and recall else None
    ratios = [j.shrink / j.shrink_true for j in single if np.isfinite(j.shrink) and j.shrink_true > 0]
    return {
        "cases": len(judged),
        "tellable": sum(j.tellable for j in single),
        "first_right_where_tellable": share([j.first_right for j in single if j.tellable]),
        "first_right": share([j.first_right for j in single]),
        "first_or_confounded": share([j.named for j in single]),
        "extra_confident": share([bool(j.blamed) for j in some]),
        "joints": {"precision": precision, "recall": recall, "f1": f1},
        "no_effect": {"cases": len(none), "false_alarms": share([j.verdict != "no_gap" for j in none])},
        "several": score_several([j for j in judged if j.kind == "several"]),
        "two": {"cases": len(two), "both_found": share([j.all_found for j in two])},
        "parameters": {
            "count": len(errors),
            "median_error": _median(errors),
            "within_10_percent": share([error <= 0.1 for error in errors]),
            "inside_ci95": share(inside),
        },
        "shrink": {"median_ratio": _median(ratios), "at_least_0.95": share([ratio >= 0.95 for ratio in ratios])},
        "verdicts": dict(Counter(j.verdict for j in judged)),
    }


def score_several(judged: Sequence[Judgement]) -> dict[str, Any]:
    """Shares over the cases with many effects: true effects named, confident causes that are false."""
    placed = [each for j in judged for each in j.placed]
    return {
        "cases": len(judged),
        "effects": len(placed),
        "named": share(placed),
        "false_confident": _ratio(sum(len(j.blamed) for j in judged), sum(j.confident for j in judged)),
        "explained": share([j.verdict == "explained" for j in judged]),
    }


def effect_withheld(judged: Sequence[Judgement]) -> dict[str, Any]:
    """Shares over the cases whose effect was removed from the library: false blames and verdicts."""
    return {
        "cases": len(judged),
        "false_blame": share([bool(j.blamed) for j in judged]),
        "no_gap": share([j.verdict == "no_gap" for j in judged]),
        "verdicts": dict(Counter(j.verdict for j in judged)),
        "blamed": [{"case": j.case, "withheld": j.withheld, "blamed": list(j.blamed)} for j in judged if j.blamed],
    }


def confusion(judged: Sequence[Judgement]) -> dict[str, dict[str, int]]:
    """Counts of single-effect and no-effect cases: true effect (or `none`) by effect named first (or verdict)."""
    table: dict[str, Counter[str]] = defaultdict(Counter)
    for j in judged:
        if j.kind in ("none", "single"):
            table[j.truth[0] if j.truth else "none"][j.first or j.verdict] += 1
    return {true: dict(table[true].most_common()) for true in sorted(table)}


def by_effect(judged: Sequence[Judgement]) -> dict[str, dict[str, Any]]:
    """Single-effect cases per effect: number, right first, named, and the median parameter error."""
    groups: dict[str, list[Judgement]] = defaultdict(list)
    for j in judged:
        if j.kind == "single":
            groups[j.truth[0]].append(j)
    return {
        effect: {
            "cases": len(here),
            "first_right": sum(j.first_right for j in here),
            "named": sum(j.named for j in here),
            "median_error": _median([e.relative for j in here for e in j.errors]),
        }
        for effect, here in sorted(groups.items())
    }


def calibration(judged: Sequence[Judgement]) -> list[dict[str, Any]]:
    """First causes by confidence: number, mean confidence, and the share that was right."""
    out = []
    for low, high in pairwise(BINS):
        here = [j for j in judged if j.first and (low <= j.confidence < high or high == 1.0 == j.confidence)]
        if here:
            mean, right = float(np.mean([j.confidence for j in here])), share([j.first_right for j in here])
            out.append({"from": low, "to": high, "count": len(here), "mean_confidence": mean, "right": right})
    return out


def case_row(j: Judgement) -> dict[str, Any]:
    same = ("case", "kind", "tellable", "verdict", "confidence", "first_right", "named")
    return {
        **{name: getattr(j, name) for name in same},
        "withheld": j.withheld or None,
        "first": j.first or None,
        "truth": list(j.truth),
        "blamed": list(j.blamed),
        "errors": {f"{e.effect}.{e.name}": e.relative for e in j.errors},
        **{name: x if np.isfinite(x) else None for name, x in (("shrink", j.shrink), ("shrink_true", j.shrink_true))},
    }


def meets_bounds(known: Mapping[str, Any], blind: Mapping[str, Any]) -> dict[str, bool]:
    """Whether labels withheld and effects withheld meet each of the project's bounds (for at least 150 cases); a share
    over no case does not."""
    least = {
        "first_right_where_tellable": (known["first_right_where_tellable"], 0.93),
        "first_or_confounded": (known["first_or_confounded"], 0.98),
        "joints_f1": (known["joints"]["f1"], 0.95),
        "two_both_found": (known["two"]["both_found"], 0.85),
        "shrink_median_ratio": (known["shrink"]["median_ratio"], 0.95),
    }
    most = {
        "extra_confident": (known["extra_confident"], 0.03),
        "no_effect_false_alarms": (known["no_effect"]["false_alarms"], 0.02),
        "parameters_median_error": (known["parameters"]["median_error"], 0.03),
        "false_blame": (blind["false_blame"], 0.10),
    }
    met = {name: value is not None and value >= bound for name, (value, bound) in least.items()}
    return met | {name: value is not None and value <= bound for name, (value, bound) in most.items()}


def share(flags: Sequence[bool]) -> float | None:
    """Share of what is true; None of nothing."""
    return sum(flags) / len(flags) if flags else None


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None
