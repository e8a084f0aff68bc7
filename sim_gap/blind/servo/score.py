"""The score of a check on positions alone: right first or named as confounded, and false causes. Pure functions."""

from collections.abc import Mapping
from typing import Any

from sim_gap.blind.judging.judge import Judgement, judge
from sim_gap.blind.judging.score import WITHHELD, by_effect, calibration, confusion, label_withheld, row, share

SCHEMA = "armlink.blind-positions/1"
NAMED, FALSE = 0.85, 0.03
"""Required share of first causes that are right or named as confounded, and of answers with a false cause above 0.8."""


def score_positions(
    answers: Mapping[str, Mapping[str, Any]], labels: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Score all answers (by name) against the labels (by case); shares over no case are None."""
    judged: list[Judgement] = []
    for name, answer in answers.items():
        case, _, withheld = name.partition(WITHHELD)
        if labels[case].get("clear", True):
            judged.append(judge(answer, labels[case], withheld))
    whole = [j for j in judged if not j.withheld]
    told = [j for j in whole if j.tellable and j.kind == "single"]
    shares = {
        "named_where_tellable": share([j.named for j in told]),
        "false_confident": share([bool(j.blamed) for j in judged]),
    }
    met = {
        "named_where_tellable": shares["named_where_tellable"] is not None and shares["named_where_tellable"] >= NAMED,
        "false_confident": shares["false_confident"] is not None and shares["false_confident"] <= FALSE,
    }
    return {
        "schema": SCHEMA,
        "answers": len(judged),
        "tellable": len(told),
        **shares,
        "label_withheld": label_withheld(whole),
        "meets": met,
        "confusion": confusion(whole),
        "by_effect": by_effect(whole),
        "calibration": calibration(judged),
        "cases": [row(j) for j in judged],
    }
