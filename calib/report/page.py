"""One self-contained HTML page from sections: text, tables and plotly figures, for screen and paper."""

from base64 import b64decode, b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from armlink.content.atomic_file import open_whole
from armlink.content.printable_text import printable_text
from calib.report.tables import ReportTable

SCRIPT = Path(__file__).with_name("plotly-basic.min.js")
"""plotly.js with lines, points and bars alone: plotly.js-basic-dist-min of npm, in the version of plotly's own."""
SCREEN = {"responsive": True, "displayModeBar": False}
FONT = {"family": "system-ui, sans-serif", "size": 13, "color": "#1c2733"}
COLOURS = ["#1f5fa8", "#d9622b", "#3c8d5a", "#8a4fa3", "#b8912b", "#4f7f95", "#a83248", "#5b6b7a"]
FIGURE_TEXTS = ("name", "text", "label", "ticktext", "x", "y")
"""Keys of plotly's figures whose texts have tags for plotly; none of ours has any."""
GRID = {"gridcolor": "#e8ecf0", "zerolinecolor": "#c6ced6", "automargin": True, "ticks": ""}
PAGE = {
    "template": {},  # plotly's own is as long as a small figure
    "colorway": COLOURS,
    "paper_bgcolor": "white",
    "plot_bgcolor": "white",
    "hovermode": "closest",
    "hoverlabel": {"align": "left", "font": {"size": 12}},
    "autotypenumbers": "strict",
}


@dataclass(frozen=True)
class ReportSection:
    """One part of a report. Text is escaped by the template, all but what is Markup."""

    title: str
    html: Markup = field(default_factory=Markup)
    figures: Sequence[Any] = ()
    """plotly figures, shown below one another."""
    tables: Sequence[ReportTable] = ()
    """Shown before the figures."""


def paragraph(text: str) -> Markup:
    return html_of("<p>{}</p>", text)


def paragraphs(texts: Iterable[str]) -> Markup:
    return Markup().join(paragraph(text) for text in texts)


def bullets(texts: Iterable[str]) -> Markup:
    return html_of("<ul>{}</ul>", Markup().join(html_of("<li>{}</li>", text) for text in texts))


def verdict_line(verdict: str, sentence: str = "") -> Markup:
    """A verdict, and a sentence on it, as an HTML paragraph."""
    return html_of('<p><span class="verdict">{}</span>{}</p>', verdict, sentence and f" {sentence}.")


def html_of(form: str, *texts: str) -> Markup:
    """Our own HTML with texts in it, which are escaped unless they are Markup."""
    return Markup(form).format(*(_shown(text) for text in texts))


def _shown(value: Any) -> Any:
    """Text without what acts on the direction of reading; anything else as it is."""
    return printable_text(value, keep="\n") if type(value) is str else value


def render(path: Path, title: str, sections: Sequence[ReportSection], subtitle: str = "") -> None:
    """Write the page with plotly's script inside, so that it opens without a network. Raises OSError."""
    from jinja2 import Environment, PackageLoader

    environment = Environment(
        loader=PackageLoader("calib.report", "."), autoescape=True, trim_blocks=True, finalize=_shown
    )
    numbered = [(f"s{i}", section, [_figure(f) for f in section.figures]) for i, section in enumerate(sections, 1)]
    page = environment.get_template("page.html.j2").stream(
        title=title, subtitle=subtitle, sections=numbered, plotly=Markup(SCRIPT.read_text(encoding="utf-8"))
    )
    with open_whole(path) as file:
        page.dump(file, encoding="utf-8")


def _figure(figure: Any) -> Markup:
    from plotly.io import to_html

    return Markup(
        to_html(styled_figure(figure), full_html=False, include_plotlyjs=False, config=SCREEN, validate=False)
    )


def styled_figure(figure: Any) -> dict[str, Any]:
    """A plotly figure as its dictionary, with grid, typeface and margins those of the page; merged by hand, for plotly
    looks through every axis anew in each figure."""
    made: dict[str, Any] = _escaped(figure.to_dict())
    layout = made["layout"]
    top = layout.get("margin", {}).get("t") or 48
    if layout.get("title", {}).get("text"):  # above a legend that takes two lines on a phone
        top = max(top, 92)
        layout["title"].update(x=0.05, y=0.98, yanchor="top")
    layout.update(PAGE)
    parts = {"font": FONT, "margin": {"l": 60, "r": 20, "b": 48, "t": top}, **dict.fromkeys(("xaxis", "yaxis"), GRID)}
    parts |= {name: GRID for name in layout if name.startswith(("xaxis", "yaxis"))}
    for name, values in parts.items():
        layout[name] = {**layout.get(name, {}), **values}
    return made


def _escaped(part: Any, key: str = "") -> Any:
    """A part of a figure with its texts escaped, in which plotly would read tags, and numbers in single precision."""
    if isinstance(part, dict):
        if part.get("dtype") == "f8":
            single = np.frombuffer(b64decode(part["bdata"])).astype("<f4")
            part = {**part, "dtype": "f4", "bdata": b64encode(single.tobytes()).decode()}
        return {each: _escaped(value, each) for each, value in part.items()}
    if isinstance(part, np.ndarray) and part.dtype.kind in "OU":
        part = part.tolist()
    if isinstance(part, list | tuple):
        return [_escaped(value, key) for value in part]
    return str(escape(_shown(part))) if isinstance(part, str) and key in FIGURE_TEXTS else part
