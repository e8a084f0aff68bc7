"""The table of a round as Markdown, and its picture as SVG."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from referee.score import SCORES, Score

BEGIN, END = "<!-- begin: written by make referee -->", "<!-- end: written by make referee -->"
ROW_PX, LABEL_PX, PANEL_PX, GAP_PX, HEAD_PX = 18, 120, 210, 24, 34
PANELS_A_ROW = 3
LEAST_LOG = 0.001
"""Left end of a panel of ratios, which is logarithmic."""


def markdown(rounds: Sequence[Mapping[str, Any]]) -> str:
    """The rounds, each with its table, what is decided, and what is not offered; then whether rounds contradict."""
    text = "\n\n".join(_round(made) for made in rounds) + "\n"
    return text + (f"\n{_contradictions(rounds)}\n" if len(rounds) > 1 else "")


def _contradictions(rounds: Sequence[Mapping[str, Any]]) -> str:
    """Pairs that one round decides, and another round has in the other order."""
    every = [d for made in rounds for d in made["summary"]["differences"]]
    decided = {(d["score"], d["better"], d["worse"]) for d in every if d["decided"]}
    order = {(d["score"], d["better"], d["worse"]) for d in every}
    turned = sorted((key, a, b) for key, a, b in decided if (key, b, a) in order)
    titles = {score.key: score.title for score in SCORES}
    text = "; ".join(f"{titles[key]}: {a} is better than {b}" for key, a, b in turned)
    return f"Differences that one round decides and another round has in the other order: {text or 'none'}."


def _round(made: Mapping[str, Any]) -> str:
    found, tools = made["summary"], made["summary"]["tools"]
    lines = [
        f"### {_title(made)}",
        f"Each tool had at most {made['cpu_seconds']:.0f} s of CPU time for a case. The labels were sealed; SHA-256 of "
        + "their hashes: "
        + ", ".join(f"`{digest[:16]}`" for digest in made["sealed"])
        + ".",
        "",
        "| score | " + " | ".join(tools) + " |",
        "|---|" + "---|" * len(tools),
    ]
    for score in SCORES:
        cells = [_cell(found, score, tool) for tool in tools]
        lines.append(f"| {score.title} | " + " | ".join(cells) + " |")
    lines.append(
        "| cases answered / failed / out of time | " + " | ".join(_states(made, tool) for tool in tools) + " |"
    )
    lines += ["", "Decided differences:", "", *_decided(found)]
    for key, counted in made["no_worse"].items():
        if not counted[1]:
            continue
        title = next(score.title for score in SCORES if score.key == key)
        better = (
            f"In {counted[0]} of {counted[1]} cases, armlink is at most 5 % above the best other tool in this score"
        )
        lines += ["", f"{better}: {title}."]
    told = Counter((row["tool"], row["state"], row["why"]) for row in made["rows"])
    reasons = [
        f"- `{tool}` {state} ({count} case{'s' * (count > 1)}): {' '.join(why.split())}"
        for (tool, state, why), count in told.items()
        if state in ("failed", "not installed")
    ]
    return "\n".join([*lines, "", "Failures:", "", *reasons] if reasons else lines)


def _title(made: Mapping[str, Any]) -> str:
    seeds = ", ".join(map(str, made["seeds"]))
    return f"{'Seeds' if len(made['seeds']) > 1 else 'Seed'} {seeds}: {made['cases']} cases, {made['date']}"


def _empty(summary: Mapping[str, Any], score: Score, tool: str) -> str:
    """Why a tool has no value."""
    if tool in summary["no_answer"]:
        return "no answer"
    return "not offered" if tool in summary["not_offered"][score.key] else "no case"


def _cell(summary: Mapping[str, Any], score: Score, tool: str) -> str:
    found = summary["scores"][score.key][tool]
    if found is None:
        return _empty(summary, score, tool)
    unit = 100.0 if score.share else 1.0
    value, low, high = (f"{unit * found[name]:.{'0f' if score.share else '3g'}}" for name in ("value", "low", "high"))
    return f"{value}{' %' if score.share else ''} ({low} to {high}; {found['cases']})"


def _states(made: Mapping[str, Any], tool: str) -> str:
    states = [row["state"] for row in made["rows"] if row["tool"] == tool]
    return " / ".join(str(states.count(state)) for state in ("answered", "failed", "out of time"))


def _decided(found: Mapping[str, Any]) -> list[str]:
    lines = []
    for score in SCORES:
        pairs: dict[str, list[str]] = {}
        for each in found["differences"]:
            if each["decided"] and each["score"] == score.key:
                pairs.setdefault(each["better"], []).append(each["worse"])
        text = "; ".join(f"{better} is better than {', '.join(worse)}" for better, worse in pairs.items())
        lines.append(f"- {score.title}: {text or 'none'}")
    return lines


def write_page(page: Path, rounds: Sequence[Mapping[str, Any]]) -> None:
    """Put the rounds between the marks of a page."""
    text = page.read_text(encoding="utf-8")
    head, _, rest = text.partition(BEGIN)
    page.write_text(f"{head}{BEGIN}\n\n{markdown(rounds)}\n{END}{rest.partition(END)[2]}", encoding="utf-8")


def svg(made: Mapping[str, Any]) -> str:
    """A panel a score: each tool's value and its interval."""
    tools, shown = made["summary"]["tools"], [score for score in SCORES if score.key != "cpu_seconds"]
    height = HEAD_PX + ROW_PX * len(tools) + GAP_PX
    wide = PANELS_A_ROW * (LABEL_PX + PANEL_PX + GAP_PX)
    tall = height * math.ceil(len(shown) / PANELS_A_ROW)
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{wide}" height="{tall}" font-family="sans-serif"'
        ' font-size="11"><rect width="100%" height="100%" fill="white"/>'
    ]
    for k, score in enumerate(shown):
        x, y = (k % PANELS_A_ROW) * (LABEL_PX + PANEL_PX + GAP_PX), (k // PANELS_A_ROW) * height
        out.append(
            f'<g transform="translate({x},{y})"><text x="4" y="14" font-weight="bold">{escape(score.title)}</text>'
        )
        out += _panel(made["summary"], score)
        out.append("</g>")
    return "\n".join([*out, "</svg>", ""])


def _panel(summary: Mapping[str, Any], score: Score) -> list[str]:
    found, tools = summary["scores"][score.key], summary["tools"]
    most = max([each["high"] for each in found.values() if each] + [1.0])

    def place(value: float) -> float:
        if score.share:
            return LABEL_PX + PANEL_PX * value
        return LABEL_PX + PANEL_PX * max(math.log(max(value, LEAST_LOG) / LEAST_LOG) / math.log(most / LEAST_LOG), 0.0)

    bottom, out = HEAD_PX + ROW_PX * len(tools), []
    for mark in (0.0, 0.5, 1.0) if score.share else (0.01, 0.1, 1.0):
        text = f"{100 * mark:.0f} %" if score.share else f"{mark:g}"
        at = f"{place(mark):.1f}"
        out.append(f'<line x1="{at}" y1="20" x2="{at}" y2="{bottom}" stroke="#ddd"/>')
        out.append(f'<text x="{at}" y="{bottom + 10}" text-anchor="middle" fill="#777">{text}</text>')
    for row, tool in enumerate(tools):
        y, each = HEAD_PX + ROW_PX * row, found[tool]
        out.append(f'<text x="4" y="{y + 4}">{escape(tool)}</text>')
        if each is None:
            out.append(f'<text x="{LABEL_PX + 6}" y="{y + 4}" fill="#999">{_empty(summary, score, tool)}</text>')
            continue
        colour = "#c03" if tool == "armlink" else "#36c"
        low, value, high = (place(each[name]) for name in ("low", "value", "high"))
        out.append(f'<line x1="{low:.1f}" y1="{y}" x2="{high:.1f}" y2="{y}" stroke="{colour}" stroke-width="2"/>')
        out.append(f'<circle cx="{value:.1f}" cy="{y}" r="4" fill="{colour}"/>')
    return out
