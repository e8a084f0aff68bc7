"""The page without a mouse or without sight: axe finds nothing, every control has a name and is reached by Tab."""

import pytest
from axe_playwright_python.sync_playwright import Axe
from made_up_view import NAMES, MadeUpView
from playwright.sync_api import Browser, Page, expect
from served_page import Served, open_page

from calib.daemon.view import State

RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "best-practice"]}


def complaints(page: Page) -> list[str]:
    """What axe finds on the page as it is now: rule and element."""
    found = Axe().run(page, options=RULES).response
    return [f"{each['id']}: {node['html'][:120]}" for each in found["violations"] for node in each["nodes"]]


def opened(browser: Browser, server: Served, view: MadeUpView, width: int, **options: object) -> Page:
    """The page with a proposal, an event and a drifted joint, everything drawn."""

    def begin() -> None:
        view.moves, view.t, view.shift = False, 60.0, 0.3
        view.propose()
        view.happen("drift", "joint_2", "joint_2 drifts", gain=1.013)

    server.do(begin)
    page = open_page(browser, server, width, **options)
    expect(page.locator("#arm-section")).to_be_visible()
    server.do(view.tick)
    expect(page.locator("#live .chart svg")).to_have_count(len(NAMES))
    return page


def test_axe_finds_nothing_and_would_find_a_button_without_a_name(
    browser: Browser, server: Served, view: MadeUpView
) -> None:
    page = opened(browser, server, view, 1200)
    assert complaints(page) == []
    page.click(".proposal button.main")
    assert complaints(page) == []
    page.click("#decision-no")
    view.state, view.fault = State.FAULT, "joint_3: no reading for 2.0 s"
    server.do(view.tick)
    expect(page.locator("#state")).to_have_text("FAULT")
    page.evaluate("document.getElementById('download-csv').ariaLabel = ''")
    page.evaluate("document.getElementById('download-csv').textContent = ''")
    assert [each.partition(":")[0] for each in complaints(page)] == ["button-name"]


@pytest.mark.long
def test_axe_finds_nothing_on_a_dark_phone(browser: Browser, server: Served, view: MadeUpView) -> None:
    page = opened(browser, server, view, 390, color_scheme="dark", is_mobile=True, has_touch=True)
    assert complaints(page) == []
    assert page.evaluate("document.documentElement.scrollWidth") == 390


def test_a_decision_by_keyboard_alone(browser: Browser, server: Served, view: MadeUpView) -> None:
    page = opened(browser, server, view, 1200)
    names = []
    for _ in range(12):
        page.keyboard.press("Tab")
        names.append(page.evaluate("document.activeElement.ariaLabel ?? document.activeElement.textContent"))
    assert names[:8] == [
        "Approve joint_2",
        "Reject joint_2",
        "Turn the view left",
        "Turn the view right",
        "View the arm from higher up",
        "View the arm from lower down",
        "1 min",
        "10 min",
    ]
    page.locator(".proposal button.main").focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog", name="Write the new calibration to joint_2?")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("#ask-decision")).to_be_hidden()
    assert page.evaluate("document.activeElement.textContent") == "Approve"  # where it was before
    page.keyboard.press("Enter")
    page.get_by_label("Your name").fill("ann")
    page.keyboard.press("Enter")
    expect(page.locator("#decided-list")).to_contain_text("approved by ann")


@pytest.mark.long
def test_the_focus_stays_where_it_is_while_the_page_is_brought_up_to_date(
    browser: Browser, server: Served, view: MadeUpView
) -> None:
    """Every two seconds, and when another proposal is made: Enter would have gone nowhere."""
    page = opened(browser, server, view, 1200)
    page.locator(".proposal button.main").focus()
    for _ in range(2):
        with page.expect_response("**/api/proposals"):
            pass
    assert page.evaluate("document.activeElement.ariaLabel") == "Approve joint_2"
    server.do(lambda: view.propose("joint_3"))
    expect(page.locator(".proposal")).to_have_count(2)
    assert page.evaluate("document.activeElement.ariaLabel") == "Approve joint_2"
