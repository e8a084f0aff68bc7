"""Confidence of the gap diagnosis: a logistic fit to blind checks whose labels are open, and how it did there.

    python tests/campaigns/gap_confidence.py BENCH [BENCH ...]

BENCH is the --out of an `armlink gap bench`. The first cause of every answer counts, right or wrong as the bench's
judge says; answers with the true effect in the library and answers without it weigh the same in all, as if every
second cause were none of the library's. The weights printed are those of `sim_gap/attribution/verdict.py`; the
table below them is the reliability of the confidences that the answers themselves gave.
"""

import argparse
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from sim_gap.attribution.diagnosis import Signs
from sim_gap.attribution.verdict import features
from sim_gap.blind.bench import open_labels
from sim_gap.blind.score import BINS, WITHHELD, judge

RIDGE = 0.01
"""Strength of the pull towards no influence, per answer and squared influence of a feature's spread."""


def answers_of(bench: Path) -> list[dict[str, Any]]:
    """First causes of a bench: features, confidence, whether right, whether the true effect was withheld."""
    answers, labels = open_labels(bench / "answers", bench / "labels")
    found = []
    for name, answer in answers.items():
        case, _, withheld = name.partition(WITHHELD)
        judged = judge(answer, labels[case], withheld) if labels[case].get("clear", True) else None
        if judged is None or not judged.first or judged.kind == "none":
            continue
        at = [cause["effect"] for cause in answer["causes"]].index(judged.first)
        signs = {key: np.inf if value is None else value for key, value in answer["signs"][at].items()}
        found.append(
            {
                "features": features(Signs(**signs)),
                "confidence": judged.confidence,
                "right": judged.first_right,
                "withheld": bool(withheld),
                "alone": not answer["causes"][at]["confounded_with"],
            }
        )
    return found


def fit(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Weights of the features and a constant; answers that name a rival themselves are left out."""
    rows = [row for row in rows if row["alone"]]
    names = list(rows[0]["features"])
    x = np.array([[1.0, *(row["features"][name] for name in names)] for row in rows])
    right, weight = np.array([row["right"] for row in rows], float), evenly(rows)
    spread = np.maximum(x.std(0), 1e-3)
    spread[0] = 1.0

    def loss(b: np.ndarray) -> float:
        p = np.clip(expit(x @ (b / spread)), 1e-9, 1.0 - 1e-9)
        fitted = -np.sum(weight * (right * np.log(p) + (1.0 - right) * np.log(1.0 - p)))
        return float(fitted + 0.5 * RIDGE * len(rows) * np.sum(b[1:] ** 2))

    best = minimize(loss, np.zeros(len(spread))).x / spread
    return dict(zip(["constant", *names], best.tolist(), strict=True))


def evenly(rows: list[dict[str, Any]]) -> np.ndarray:
    """Weights by which both kinds of answer count the same in all, their mean being 1."""
    withheld = np.array([row["withheld"] for row in rows])
    share = np.where(withheld, withheld.mean(), 1.0 - withheld.mean())
    return np.asarray(0.5 / share)


def reliability(rows: list[dict[str, Any]]) -> None:
    """Print, by confidence given, how many answers of each kind there were and how many were right."""
    weight = evenly(rows)
    print("| confidence | in the library | right | withheld | right, both kinds counting the same |")
    print("|---|---|---|---|---|")
    for low, high in pairwise(BINS):
        here = [low <= row["confidence"] < high for row in rows]
        told = [row for row, yes in zip(rows, here, strict=True) if yes and not row["withheld"]]
        blind = sum(yes and row["withheld"] for row, yes in zip(rows, here, strict=True))
        if not any(here):
            continue
        right = sum(row["right"] for row in told)
        share = np.average([row["right"] for row in rows], weights=weight * here)
        print(f"| {low:g} to {high:g} | {len(told)} | {right} | {blind} | {share:.0%} |")


def main() -> None:
    """Fit the weights to the benches given and print both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("bench", nargs="+", type=Path)
    rows = [row for bench in parser.parse_args().bench for row in answers_of(bench)]
    print(f"{len(rows)} first causes, {sum(row['withheld'] for row in rows)} of them with the effect withheld")
    print("WEIGHTS =", {name: round(value, 2) for name, value in fit(rows).items()})
    reliability(rows)


if __name__ == "__main__":
    main()
