"""Score of the blind cases without a torque channel."""

from collections.abc import Mapping
from typing import Any

from sim_gap.blind.judge import Judgement, judge
from sim_gap.blind.score import WITHHELD, by_effect, calibration, case_row, confusion, label_withheld, share

POSITIONS_SCHEMA = "armlink.blind-positions/1"
NAMED_SHARE, FALSE_SHARE = 0.85, 0.03
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
    named, false = share([j.named for j in told]), share([bool(j.blamed) for j in judged])
    shares = {"named_where_tellable": named, "false_confident": false}
    met = {
        "named_where_tellable": named is not None and named >= NAMED_SHARE,
        "false_confident": false is not None and false <= FALSE_SHARE,
    }
    return {
        "schema": POSITIONS_SCHEMA,
        "answers": len(judged),
        "tellable": len(told),
        **shares,
        "label_withheld": label_withheld(whole),
        "meets": met,
        "confusion": confusion(whole),
        "by_effect": by_effect(whole),
        "calibration": calibration(judged),
        "cases": [case_row(j) for j in judged],
    }
