"""The documentation holds: links lead somewhere, commands that it names exist, and blocks marked `.run` run.

A fenced block that opens with ```{ .sh .run } is executed, the blocks of one page in order and in one empty folder,
with the commands of the virtual environment on the path. In every other ```sh block, each armlink command and option
must exist.
"""

import os
import re
import shlex
import subprocess
import sys
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import yaml

from armlink import cli
from armlink.arm_file import parse_arm
from calib.commissioning.doctor import examine

ROOT = Path(__file__).parent.parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
FENCE = re.compile(r"^```(?P<info>[^\n`]*)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\((?P<target>[^)\s]+)\)")
COMMANDS = {point.name for point in entry_points(group="armlink.commands")}
TARGETS = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


RUN = "{ .sh .run }"
INFO = re.compile(r"""(\w*( title="[^"]*")?|\{( \.\w+)+ \})""")
"""What the site takes as the first line of a block; any other makes text of the block and of what follows."""


@cache
def text_of(page: Path) -> str:
    return page.read_text()


@cache
def prose_of(page: Path) -> str:
    """A page without its blocks."""
    return FENCE.sub("", text_of(page))


def blocks(page: Path, info: str) -> list[str]:
    return [found["text"] for found in FENCE.finditer(text_of(page)) if found["info"].strip() == info]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_block_opens_as_the_site_wants_it(page):
    for found in FENCE.finditer(text_of(page)):
        assert INFO.fullmatch(found["info"].strip()), found["info"]


@cache
def anchors(page: Path) -> set[str]:
    """What GitHub makes of a page's headings."""
    headings = re.findall(r"^#+ (.*)$", prose_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def shell_lines() -> list[tuple[str, list[str]]]:
    """Page and words of each simple command in the sh blocks, comments and variable settings left out."""
    lines = []
    for page in PAGES:
        for text in blocks(page, "sh") + blocks(page, RUN):
            for line in text.replace("\\\n", " ").splitlines():
                for simple in re.split(r"\s(?:\||&&|>|2>|;)\s", line):
                    words = shlex.split(simple, comments=True)
                    while words and (words[0] in ("sudo", "time") or re.fullmatch(r"\w+=.*", words[0])):
                        words = words[1:]
                    if words:
                        lines.append((name(page), words))
    return lines


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page):
    for found in LINK.finditer(prose_of(page)):
        target, _, anchor = found["target"].partition("#")
        if "://" in target or target.startswith("mailto:"):
            continue
        other = (page.parent / target).resolve() if target else page
        assert other.exists(), f"{name(page)}: {target}"
        assert other.is_relative_to(ROOT), f"{name(page)}: {target} lies outside the project"
        if anchor and other.suffix == ".md":
            assert anchor in anchors(other), f"{name(page)}: {target}#{anchor}"


@cache
def pages_reached_from_the_readme() -> frozenset[Path]:
    reached, queue = set(), [ROOT / "README.md"]
    while queue:
        here = queue.pop()
        if here in reached:
            continue
        reached.add(here)
        for found in LINK.finditer(text_of(here)):
            there = (here.parent / found["target"].partition("#")[0]).resolve()
            if there.suffix == ".md" and there.is_file():
                queue.append(there)
    return frozenset(reached)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_a_page_is_reached_from_the_readme(page):
    assert page in pages_reached_from_the_readme()


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_a_list_or_table_follows_an_empty_line_or_a_heading(page):
    """GitHub does not ask for it, but the site would show the rows as one paragraph."""
    before, inside = "", False
    for line in prose_of(page).splitlines():
        starts = re.match(r"[-*] |\d+\. |\|.*\|$", line)
        assert not starts or inside or not before.strip() or before.startswith("#"), f"{name(page)}: {line}"
        inside = bool(starts) or (inside and bool(line.strip()))
        before = line


def test_commands_and_options_in_the_documentation_exist(capsys):
    helps: dict[tuple[str, ...], str] = {}
    for page, words in shell_lines():
        if words[0] == "make":
            wanted = {word for word in words[1:] if "=" not in word}
            assert wanted <= TARGETS, f"{page}: make {' '.join(wanted - TARGETS)}"
        if words[0] != "armlink" or words[1:2] in (["--help"], ["--version"]):
            continue
        command = words[1]
        assert command in COMMANDS, f"{page}: armlink {command}"
        path = (command, words[2]) if command == "gap" and not words[2].startswith("-") else (command,)
        if path not in helps:
            assert cli.run([*path, "--help"]) == 0, f"{page}: armlink {' '.join(path)}"
            helps[path] = capsys.readouterr().out
        for option in re.findall(r"(?:^| )(--[a-z][a-z0-9-]*)", " ".join(words[len(path) + 1 :])):
            assert re.search(rf"{option}\b(?!-)", helps[path]), f"{page}: armlink {' '.join(path)} has no {option}"


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "yaml")], ids=name)
def test_arm_files_in_the_documentation_are_valid(page, tmp_path):
    for text in blocks(page, "yaml"):
        if text.startswith("name:"):
            assert parse_arm(yaml.safe_load(text), page).joint_names
            (tmp_path / "my-arm.yaml").write_text(text)
            found = examine(str(tmp_path / "my-arm.yaml"), offline=True)
            assert [str(each) for each in found if each.level == "error"] == []


@pytest.mark.sample(1)  # `test_docs_walk.py` types the others' in this process
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, RUN)], ids=name)
def test_the_commands_of_a_page_run(page, tmp_path):
    script = "set -euo pipefail\n" + "\n".join(blocks(page, RUN))
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "XDG_STATE_HOME": str(tmp_path / "state"), "COLUMNS": "120"}
    done = subprocess.run(
        ["bash", "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
