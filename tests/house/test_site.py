"""The documentation site builds without a warning, and is viewed and searched without a network.

One page of it here, by the same settings; the whole site, which takes half a minute, in `make long` and `make docs`.
"""

import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
LOADS = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src", "link": "href"}
"""Attributes that a browser fetches by itself."""
ELSEWHERE = re.compile(r"^(?:[a-z]+:)?//")


class Loads(HTMLParser):
    """Collects the addresses that a page loads from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag, attrs):
        address = dict(attrs).get(LOADS.get(tag, ""), "") or ""
        if ELSEWHERE.match(address):
            self.found.append(address)


def build(root: Path, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    return subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False, timeout=300)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    done = build(ROOT, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stderr
    return folder


@pytest.mark.long
def test_a_link_that_leads_nowhere_fails_the_build(tmp_path):
    """By the site's own settings, on one page."""
    page = tmp_path / "docs" / "index.md"
    for folder in (page.parent, tmp_path / "scripts"):
        folder.mkdir()
    shutil.copy(ROOT / "scripts" / "site_hooks.py", tmp_path / "scripts")
    (tmp_path / "mkdocs.yml").write_text(f"INHERIT: {ROOT / 'mkdocs.yml'}\nnav: [index.md]\n", encoding="utf-8")
    page.write_text("# One page\n\nWith a link to [itself](index.md).\n", encoding="utf-8")
    done = build(tmp_path, tmp_path / "site")
    assert done.returncode == 0, done.stdout + done.stderr
    require_nothing_from_elsewhere(tmp_path / "site")
    with page.open("a", encoding="utf-8") as text:
        text.write("\n[nowhere](nowhere.md)\n")
    done = build(tmp_path, tmp_path / "site")
    assert done.returncode != 0
    assert "nowhere.md" in done.stderr


def require_nothing_from_elsewhere(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert pages
    for page in pages:
        loads = Loads()
        loads.feed(page.read_text(encoding="utf-8"))
        assert not loads.found, page.name
    for style in site.rglob("*.css"):
        assert not re.search(r"url\([\"']?(?:https?:)?//", style.read_text(encoding="utf-8")), style.name


@pytest.mark.long
def test_no_page_loads_anything_from_elsewhere(site):
    require_nothing_from_elsewhere(site)


@pytest.mark.long
def test_files_outside_the_docs_are_there(site):
    for name in ("CHANGELOG.html", "CONTRIBUTING.html", "examples/planar3.yaml", "packaging/armlink@.service"):
        assert (site / name).is_file(), name


@pytest.mark.long
def test_the_reference_has_names_and_commands(site):
    api = (site / "reference" / "gcomp.html").read_text(encoding="utf-8")
    assert "gravity_torque" in api
    commands = (site / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "armlink gap diagnose" in commands
    assert "--reference-mass" in commands


@pytest.mark.long
def test_the_landing_page_shows(site, look):
    seen = look(site / "index.html")
    assert seen.console == ()
    assert "Where to begin" in seen.document
    assert seen.colours() > 100


@pytest.mark.long
def test_the_search_finds_from_disk(site, look):
    page = site / "search.html"
    page.write_text('<meta http-equiv="refresh" content="0; url=index.html?q=payload">')
    assert re.search(r"[1-9]\d* matching documents", look(page).document)
