"""One self-contained HTML page from sections: text, tables and plotly figures, for screen and paper."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

from armlink.atomic_file import open_whole

SCREEN = {"responsive": True, "displayModeBar": False}
FONT = {"family": "system-ui, sans-serif", "size": 13, "color": "#1c2733"}
COLOURS = ["#1f5fa8", "#d9622b", "#3c8d5a", "#8a4fa3", "#b8912b", "#4f7f95", "#a83248"]
MARGIN = {"l": 60, "r": 20, "b": 48}
GRID = {"gridcolor": "#e8ecf0", "zerolinecolor": "#c6ced6", "automargin": True}


@dataclass(frozen=True)
class Section:
    """One part of a report. `html` and table cells are trusted; use `escape` on text from outside."""

    title: str
    html: str = ""
    figures: Sequence[Any] = ()
    """plotly figures, shown below one another."""
    tables: Sequence["ReportTable"] = ()
    """Shown before the figures."""


@dataclass(frozen=True)
class ReportTable:
    """A table with a caption; numbers are formatted already."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    texts: int = field(default=1, kw_only=True)
    """Number of text columns, from the left; the others are numbers, aligned right."""


def paragraph(text: str) -> str:
    """Plain text as an HTML paragraph, escaped."""
    return f"<p>{escape(text)}</p>"


def render(path: Path, title: str, sections: Sequence[Section], subtitle: str = "") -> None:
    """Write the page with plotly's script inside, so that it opens without a network. Raises OSError."""
    from jinja2 import Environment, PackageLoader
    from plotly.offline import get_plotlyjs

    environment = Environment(loader=PackageLoader("calib.report", "."), autoescape=False, trim_blocks=True)
    numbered = [(f"s{i}", section, [_figure(f) for f in section.figures]) for i, section in enumerate(sections, 1)]
    page = environment.get_template("page.html.j2").stream(
        title=escape(title), subtitle=escape(subtitle), sections=numbered, plotly=get_plotlyjs()
    )
    with open_whole(path) as file:  # piece by piece: a page has ten megabytes
        page.dump(file, encoding="utf-8")


def _figure(figure: Any) -> str:
    from plotly.io import to_html

    return str(to_html(styled(figure), full_html=False, include_plotlyjs=False, config=SCREEN, validate=False))


def styled(figure: Any) -> dict[str, Any]:
    """A plotly figure as its dictionary, with grid, typeface and margins those of the page.

    Merged by hand: plotly looks through a template and every axis anew in each figure.
    """
    made: dict[str, Any] = figure.to_dict()
    layout = made["layout"]
    top = layout.get("margin", {}).get("t") or 48
    if layout.get("title", {}).get("text"):  # above a legend that takes two lines on a phone
        top = max(top, 92)
        layout["title"].update(y=0.98, yanchor="top")
    layout.update(template=_template(), colorway=COLOURS, paper_bgcolor="white")
    parts = {"font": FONT, "margin": {**MARGIN, "t": top}, **dict.fromkeys(("xaxis", "yaxis"), GRID)}
    parts |= {name: GRID for name in layout if name.startswith(("xaxis", "yaxis"))}
    for name, values in parts.items():
        layout[name] = {**layout.get(name, {}), **values}
    label = layout.setdefault("hoverlabel", {})
    label["font"] = {**label.get("font", {}), "size": 12}
    return made


@cache
def _template() -> dict[str, Any]:
    from plotly.io import templates

    made: dict[str, Any] = templates["plotly_white"].to_plotly_json()
    return made
