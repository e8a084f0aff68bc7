"""The API served for real, on a Unix socket and on loopback, from a thread with an event loop of its own."""

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from made_up_view import MadeUpView
from playwright.sync_api import Browser, sync_playwright
from served_page import Served, served


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[MadeUpView, Served]]:
    view = MadeUpView()
    with served(lambda: view, tmp_path_factory.mktemp("api") / "api.sock") as server:
        yield view, server


@pytest.fixture
def server(running: tuple[MadeUpView, Served]) -> Served:
    """One server for a whole file; each test finds its view as new."""
    view, server = running
    server.do(view.begin)
    return server


@pytest.fixture
def view(running: tuple[MadeUpView, Served]) -> MadeUpView:
    return running[0]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """A real Chromium without a window; while it is there, Playwright's own event loop runs in this thread."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("no Chromium: scripts/install-system installs it where that is allowed")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()
