"""Scores of answers against labels, their intervals over cases, and which differences are decided. Pure functions."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy import stats

from referee.interface import FAMILY, TABLES, Answer, Cause, Parameter, family, target

SURE = 0.8
"""Confidence above which a cause is meant to be sure (interface.py)."""
FAILED_RATIO = 1.0
"""Of a tool that gave no model: its user is left with the nominal one."""
LEAST_DISCORDANT = 6
"""Least number of cases that differ: of fewer, a two-sided sign test says nothing at 5 % (2 · 0.5⁶ = 0.03)."""
WRONG_DECISIONS = 0.05
"""Probability that any of the differences that a score decides is due to the draw of the cases."""
DRAWS, WILSON_Z = 2000, 1.959964
TINY = 1e-4
"""Relative errors and widths below this count as this; widths above its inverse, as those without an end, as that."""
Json = Mapping[str, Any]


@dataclass(frozen=True)
class Score:
    key: str
    title: str
    share: bool
    """A share of cases, the larger the better; otherwise a geometric mean, the smaller the better, unless turned."""
    less_is_better: bool
    needs: frozenset[str]
    """What a tool has to offer for it."""


def offers(answer: Answer) -> list[str]:
    """What an answer has: causes, parameters, intervals, no causes, model."""
    parts = {
        "causes": answer.causes is not None,
        "no causes": answer.causes is None,
        "parameters": answer.parameters is not None,
        "intervals": any(p.low is not None for p in answer.parameters or ()),
        "model": answer.model is not None,
    }
    return [name for name, there in parts.items() if there]


SCORES = (
    Score("first_right", "right cause first", True, False, frozenset({"causes"})),
    Score(
        "read_right",
        "right effect read from the parameters",
        True,
        False,
        frozenset({"intervals", "no causes"}),
    ),
    Score("false_sure", "false cause with a confidence above 0.8", True, True, frozenset({"causes"})),
    Score("abstains", "no confident cause if none can be named", True, False, frozenset({"causes"})),
    Score("error", "error of a parameter / its true change", False, True, frozenset({"parameters"})),
    Score("coverage", "95 % intervals that contain the true value", True, False, frozenset({"intervals"})),
    Score("width", "width of an interval / the true change", False, True, frozenset({"intervals"})),
    Score("residual", "held-out residual / that of the nominal model", False, True, frozenset({"model"})),
    Score("rollout", "roll-out error in MuJoCo / that of the nominal model", False, True, frozenset({"model"})),
    Score("cpu_seconds", "CPU time [s]", False, True, frozenset()),
)


def judge(answer: Answer, label: Json) -> dict[str, float | None]:
    """The scores of an answer that follow from the label; None where the tool or the case does not have one."""
    words, withheld = answer.vocabulary, set(label["withheld"])
    true = {FAMILY[e["effect"]] for e in label["effects"] if e["effect"] not in withheld}
    implied = {FAMILY[name] for e in label["effects"] for name in e["implied"] if name in FAMILY}
    alike = {FAMILY[name] for e in label["effects"] if e["undecided"] for name in e["confused_with"] if name in FAMILY}
    right, fine = true | alike, true | alike | implied | {FAMILY[name] for name in label["nearest"]}
    nameable, whole = bool(true), not withheld and not label["outside"]
    scores: dict[str, float | None] = dict.fromkeys(each.key for each in SCORES)
    if answer.causes is not None:
        false = any(c.confidence > SURE and family(c.name, words) not in fine for c in answer.causes)
        scores["false_sure"] = float(false)
        if nameable:
            scores["first_right"] = float(_first(answer.causes, words, right, implied) in right)
        elif not label.get("real"):
            scores["abstains"] = float(not false)
    if answer.parameters is not None and whole:
        scores |= _parameter_scores(answer.parameters, words, label["truth"])
        compared = [p for p in answer.parameters if family(p.name, words) in TABLES["families"]]
        stated = [p for p in compared if None not in (p.low, p.high, p.nominal)]
        if answer.causes is None and nameable and stated:
            scores["read_right"] = float(family(max(stated, key=_deviations).name, words) in right)
    return scores


def _first(causes: Sequence[Cause], words: str, right: set[str], implied: set[str]) -> str:
    """Family of the first cause; those that a true effect brings with it are skipped."""
    named = [family(cause.name, words) for cause in causes]
    return next((each for each in named if each in right or each not in implied), "")


def _deviations(p: Parameter) -> float:
    """Distance from the nominal value, in half widths of the interval."""
    low, high, nominal = (p.value if x is None else x for x in (p.low, p.high, p.nominal))
    return abs(p.value - nominal) / max(0.5 * (high - low), 1e-12)


def _parameter_scores(parameters: Sequence[Parameter], words: str, truth: Iterable[Json]) -> dict[str, float | None]:
    known = {(f"{row['effect']}:{row['quantity']}", row["joint"]): row for row in truth}
    errors, widths, inside = [], [], []
    for p in parameters:
        row = known.get((target(p.name, words), p.joint))
        if row is None:
            continue
        change = abs(row["value"] - row["nominal"])
        if row["drawn"] and change > 0.0:
            errors.append(math.log(max(abs(p.value - row["value"]) / change, TINY)))
        if p.low is not None and p.high is not None:
            inside.append(p.low <= row["value"] <= p.high)
            if row["drawn"] and change > 0.0:
                widths.append(math.log(min(max((p.high - p.low) / change, TINY), 1.0 / TINY)))
    return {
        "error": math.exp(np.mean(errors)) if errors else None,
        "width": math.exp(np.mean(widths)) if widths else None,
        "coverage": float(np.mean(inside)) if inside else None,
    }


def complete(rows: Sequence[dict[str, Any]]) -> None:
    """Count a tool that failed as one that named nothing and left the nominal model, in the scores that it offers for
    other cases of that kind."""
    for row in rows:
        if row["state"] in ("failed", "out of time"):
            same = [r for r in rows if r["tool"] == row["tool"] and r["state"] == "answered"]
            offered = {key for r in same for key, value in r["scores"].items() if value is not None}
            empty = {"first_right": 0.0, "read_right": 0.0, "false_sure": 0.0, "abstains": 1.0}
            empty |= {"residual": FAILED_RATIO, "rollout": FAILED_RATIO}
            for key, value in empty.items():
                applies = row["nameable"] if key.endswith("right") else not row["nameable"] or key != "abstains"
                if key in offered and applies:
                    row["scores"][key] = value


def summary(rows: Sequence[dict[str, Any]], seed: int = 0) -> dict[str, Any]:
    """Every score of every tool with its interval, and each pair of tools, the better one first: whether the score
    decides between them. The pairs of a score share `WRONG_DECISIONS` (Bonferroni)."""
    tools = list(dict.fromkeys(row["tool"] for row in rows))
    table: dict[str, dict[str, Any]] = {}
    differences: list[dict[str, Any]] = []
    for score in SCORES:
        values = {tool: _by_case(rows, tool, score.key) for tool in tools}
        table[score.key] = {
            tool: estimate([*cases.values()], score, seed) if cases else None for tool, cases in values.items()
        }
        common = {pair: values[pair[0]].keys() & values[pair[1]].keys() for pair in combinations(tools, 2)}
        pairs = {pair: sorted(cases) for pair, cases in common.items() if cases}
        for (first, second), cases in pairs.items():
            better = advantage([(values[first][case], values[second][case]) for case in cases], score)
            if better.mean() < 0.0:
                first, second, better = second, first, -better
            made = {"score": score.key, "better": first, "worse": second, "cases": len(cases)}
            differences.append({**made, "decided": is_decided(better, WRONG_DECISIONS / len(pairs))})
    offered = {tool: {part for row in rows if row["tool"] == tool for part in row["offers"]} for tool in tools}
    states = {tool: {row["state"] for row in rows if row["tool"] == tool} for tool in tools}
    silent = [t for t in tools if "answered" not in states[t] and states[t] & {"failed", "out of time"}]
    missing = {s.key: [t for t in tools if t not in silent and not s.needs <= offered[t]] for s in SCORES}
    found = {"tools": tools, "scores": table, "differences": differences}
    return {**found, "not_offered": missing, "no_answer": silent}


def _by_case(rows: Sequence[dict[str, Any]], tool: str, key: str) -> dict[str, float]:
    return {r["case"]: r["scores"][key] for r in rows if r["tool"] == tool and r["scores"].get(key) is not None}


def estimate(values: Sequence[float], score: Score, seed: int = 0) -> dict[str, float]:
    """Mean share or geometric mean over cases, with its 95 % interval: Wilson's of yes or no, else the bootstrap's."""
    if score.share and set(values) <= {0.0, 1.0}:
        low, high = wilson(sum(values), len(values))
        return {"value": float(np.mean(values)), "low": low, "high": high, "cases": len(values)}
    x = np.asarray(values, float) if score.share else np.log(np.maximum(values, TINY))
    draws = _resampled(x, seed)
    back = (lambda y: float(y)) if score.share else (lambda y: math.exp(y))
    low, high = np.quantile(draws, [0.025, 0.975])
    return {"value": back(x.mean()), "low": back(low), "high": back(high), "cases": len(values)}


def wilson(count: float, total: int) -> tuple[float, float]:
    """95 % interval of a share."""
    share, z2 = count / total, WILSON_Z**2
    middle = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = WILSON_Z / (1 + z2 / total) * math.sqrt(share * (1 - share) / total + z2 / (4 * total**2))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def advantage(pairs: Sequence[tuple[float, float]], score: Score) -> Any:
    """By how much the first of each pair is better: of shares their difference, of other values that of logarithms."""
    both = np.reshape(np.asarray(pairs, float), (-1, 2))
    if not score.share:
        both = np.log(np.maximum(both, TINY))
    return (both[:, 1] - both[:, 0]) if score.less_is_better else (both[:, 0] - both[:, 1])


def is_decided(better: Any, level: float) -> bool:
    """Whether a mean advantage over cases is above zero in a t-test at half this level (two-sided: at this level), and
    enough cases differ."""
    if np.count_nonzero(better) < LEAST_DISCORDANT:
        return False
    error = float(np.std(better, ddof=1)) / math.sqrt(len(better))
    return bool(better.mean() > stats.t.ppf(1.0 - 0.5 * level, len(better) - 1) * error)


def _resampled(x: Any, seed: int) -> Any:
    """Bootstrap means."""
    return np.random.default_rng(seed).choice(x, (DRAWS, len(x))).mean(1)


def no_worse(rows: Sequence[dict[str, Any]], tool: str, key: str, margin: float) -> tuple[int, int]:
    """In how many cases a tool is at most `margin` above the best other one in a score of which less is better, and in
    how many it could be compared."""
    cases = _by_case(rows, tool, key)
    others = [_by_case(rows, other, key) for other in {row["tool"] for row in rows} - {tool}]
    best = {
        case: min(each[case] for each in others if case in each) for case in cases if any(case in o for o in others)
    }
    return sum(cases[case] <= (1.0 + margin) * value for case, value in best.items()), len(best)
