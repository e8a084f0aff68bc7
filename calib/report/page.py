"""One self-contained HTML page from sections: text, tables and plotly figures, for screen and paper."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

SCREEN = {"responsive": True, "displayModeBar": False}


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
    page = environment.get_template("page.html.j2").render(
        title=escape(title), subtitle=escape(subtitle), sections=numbered, plotly=get_plotlyjs()
    )
    path.write_text(page, encoding="utf-8")


def _figure(figure: Any) -> str:
    style(figure)
    return str(figure.to_html(full_html=False, include_plotlyjs=False, config=SCREEN))


def style(figure: Any) -> None:
    """Set a plotly figure's grid, typeface and margins to those of the page."""
    top = figure.layout.margin.t or 48
    if figure.layout.title.text:  # above a legend that takes two lines on a phone
        top = max(top, 92)
        figure.update_layout(title={"y": 0.98, "yanchor": "top"})
    figure.update_layout(
        template="plotly_white",
        font={"family": "system-ui, sans-serif", "size": 13, "color": "#1c2733"},
        colorway=["#1f5fa8", "#d9622b", "#3c8d5a", "#8a4fa3", "#b8912b", "#4f7f95", "#a83248"],
        margin={"l": 60, "r": 20, "t": top, "b": 48},
        paper_bgcolor="white",
        hoverlabel={"font_size": 12},
    )
    figure.update_xaxes(gridcolor="#e8ecf0", zerolinecolor="#c6ced6", automargin=True)
    figure.update_yaxes(gridcolor="#e8ecf0", zerolinecolor="#c6ced6", automargin=True)
