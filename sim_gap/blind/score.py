"""The score of blind checks (docs/formats.md) from judged answers: shares, confusion matrix. Pure functions."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from sim_gap.blind.judge import Judgement, judge

SCHEMA = "armlink.blind/1"
POSITIONS_SCHEMA = "armlink.blind-positions/1"
NAMED_SHARE, FALSE_SHARE = 0.85, 0.03
"""Of positions alone: required share of first causes that are right or named as confounded, and of answers with a false
cause above 0.8."""
Answers = Mapping[str, Mapping[str, Any]]
"""Answers or labels by name."""
BINS = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0)
WITHHELD = "--without--"
"""Separator of case and effect removed from the library, in an answer's name."""


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
