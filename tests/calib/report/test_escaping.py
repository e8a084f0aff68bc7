"""Names on a report are text: no tag, no script, nothing that turns the direction of reading."""

from html.parser import HTMLParser
from pathlib import Path

import plotly.graph_objects as graph
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plotly.offline import get_plotlyjs_version

import calib.report.page as report_page
from calib.report.page import ReportSection, bullets, html_of, paragraph, paragraphs, render, verdict_line
from calib.report.tables import ReportTable

HOSTILE = (
    "<x-evil>",
    "</script><x-evil>",
    '"><x-evil a="',
    "<!--<x-evil>",
    "]]><x-evil>",
    "{{ 7 * 7 }}",
    "{% raw %}<x-evil>",
    "{0.__class__}",
    "<a href=javascript:alert(1)>x</a>",
    "&lt;x-evil&gt;",
    "\u202e<x-evil>",
    "a\nb\u2028c",
)
NAMES = st.one_of(st.sampled_from(HOSTILE), st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=30))


class Tags(HTMLParser):
    """Tags of a page, and its texts outside of scripts and styles."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.texts: list[str] = []
        self._raw = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self._raw = tag in ("script", "style")

    def handle_endtag(self, tag: str) -> None:
        self._raw = False

    def handle_data(self, data: str) -> None:
        if not self._raw:
            self.texts.append(data)


def page_with(name: str, folder: Path) -> Tags:
    """A page with a name in each of its places."""
    figure = graph.Figure()
    figure.add_bar(x=[name, "b"], y=[1.0, 2.0], name=name, text=[name, "b"])
    figure.update_layout(title=name, xaxis={"title": {"text": name}, "ticktext": [name], "tickvals": [0]})
    html = paragraph(name) + paragraphs([name]) + bullets([name]) + verdict_line(name, name)
    html += html_of("<b>{}</b>", name)
    table = ReportTable((name, "value"), [[name, "1"], [html_of("<i>{}</i>", name), name]], name)
    path = folder / "page.html"
    render(path, name, [ReportSection(name, html, [figure], [table]), ReportSection("other", name)], name)
    found = Tags()
    found.feed(path.read_text(encoding="utf-8"))
    return found


@pytest.fixture(autouse=True)
def _without_plotly(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Its script has a megabyte, and is the same in every page."""
    script = folder / "plotly.js"
    script.write_text("/* plotly */")
    monkeypatch.setattr(report_page, "SCRIPT", script)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pages")


def test_a_page_has_the_same_tags_whatever_names_are_on_it(folder: Path) -> None:
    plain = page_with("elbow", folder).tags

    @settings(deadline=None, max_examples=40, derandomize=True)
    @given(NAMES)
    def check(name: str) -> None:
        found = page_with(name, folder)
        assert found.tags == plain
        assert "x-evil" not in found.tags
        assert not {"\u202e", "\u2066", "\u2067", "\u202d"} & set("".join(found.texts))

    check()


@pytest.mark.parametrize("name", ["<x-evil>", "a & b", "{{ 7 * 7 }}"])
def test_a_name_reads_as_it_is(name: str, folder: Path) -> None:
    assert name in page_with(name, folder).texts


def test_the_page_has_the_script_of_the_plotly_that_makes_its_figures() -> None:
    script = Path(report_page.__file__).with_name("plotly-basic.min.js").read_text(encoding="utf-8")
    assert script.splitlines()[1] == f"* plotly.js (basic - minified) v{get_plotlyjs_version()}"
    assert len(script) < 1_300_000


def test_texts_of_figures_are_escaped_for_plotly_too() -> None:
    """It reads tags in them by itself."""
    made = report_page.styled_figure(graph.Figure().add_bar(x=["<b>a</b>"], y=[1.0], name="<a href='x'>b</a>"))
    assert made["data"][0]["name"] == "&lt;a href=&#39;x&#39;&gt;b&lt;/a&gt;"
    assert list(made["data"][0]["x"]) == ["&lt;b&gt;a&lt;/b&gt;"]
