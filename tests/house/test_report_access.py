"""The reports without sight, and on a phone: axe finds nothing in text and tables; nothing is wider than the screen."""

import shutil
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, sync_playwright

from calib.report.page import ReportSection as Section
from calib.report.page import paragraph, render
from calib.report.tables import ReportTable

RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "best-practice"]}


def complaints(browser: Browser, page: Path, width: int) -> list[str]:
    shown = browser.new_page(viewport={"width": width, "height": 900})
    shown.goto(page.as_uri())
    found = Axe().run(shown, options=RULES).response
    wide = shown.evaluate("document.documentElement.scrollWidth")
    shown.close()
    return [f"{each['id']}: {node['html'][:120]}" for each in found["violations"] for node in each["nodes"]] + (
        [f"{wide} wide"] if wide > width else []
    )


@pytest.mark.sample(1)
@pytest.mark.parametrize("width", [1280, 390])
def test_axe_finds_nothing_and_would_find_a_heading_without_words(tmp_path, width):
    import plotly.graph_objects as go

    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("no Chromium: scripts/install-system installs it where that is allowed")
    wide = ReportTable([f"column {i} [N·m]" for i in range(12)], [[f"{i}.123456" for i in range(12)]], "a wide table")
    facts = ReportTable((), [["arm", f"<small>{'0' * 64}</small>"]], texts=2)
    verdict = '<p><span class="verdict">the model holds</span></p>' + paragraph("Write it to the controllers.")
    sections = [
        Section("Verdict", verdict + "<p><code>armlink calibrate unloaded loaded --apply</code></p>", (), [facts]),
        Section("Sensors", paragraph("Gains and offsets."), [go.Figure(go.Bar(x=["j1"], y=[1.0]))], [wide, wide]),
    ]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        render(tmp_path / "report.html", "Calibration", sections, "today")
        assert complaints(browser, tmp_path / "report.html", width) == []
        render(tmp_path / "bad.html", "Calibration", [Section("", "")])
        assert [each.partition(":")[0] for each in complaints(browser, tmp_path / "bad.html", width)] != []
        browser.close()
