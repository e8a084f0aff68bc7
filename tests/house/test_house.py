"""Files that hold the house together: constraints, import contracts, commands and their help."""

import ast
import importlib.util
import re
import subprocess
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import yaml

from armlink import cli

ROOT = Path(__file__).parent.parent.parent
COMMANDS = {point.name: point for point in entry_points(group="armlink.commands")}


NOT_INSTALLED = ("notebooks", "rerun")
"""Extras that are not in dev: a notebook's editor, and 500 MB."""


def test_constraints_are_exact_pins_and_name_no_registry():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert lines
    for line in lines:
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", line), line


def test_constraints_cover_every_dependency():
    def name(requirement: str) -> str:
        return re.split(r"[<>=\[;! ]", requirement)[0].lower().replace("_", "-")

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = project["project"]["dependencies"] + project["build-system"]["requires"]
    extras = project["project"]["optional-dependencies"]
    wanted += [one for title, extra in extras.items() if title not in NOT_INSTALLED for one in extra]
    pinned = {"armlink"} | {name(line) for line in (ROOT / "constraints.txt").read_text().splitlines()}
    assert {name(one) for one in wanted} <= pinned


def test_the_import_contracts_hold():
    linter = Path(sys.executable).parent / "lint-imports"
    done = subprocess.run([linter, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_a_command_s_help_has_its_purpose_and_an_example(name, capsys):
    assert cli._summary(COMMANDS[name]), "the module's docstring is its line in armlink --help"
    assert cli.run([name, "--help"]) == 0
    text = capsys.readouterr().out
    if "Commands" in text:  # a group: its commands have the examples
        tree = ast.parse(Path(importlib.util.find_spec(COMMANDS[name].module).origin).read_text())
        text = " ".join(ast.get_docstring(node) or "" for node in tree.body if isinstance(node, ast.FunctionDef))
    assert f"armlink {name}" in " ".join(text.split())


def test_version_and_date_are_the_same_everywhere():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    newest = re.search(r"^## (\d\S*) – (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest.groups() == (version, str(citation["date-released"]))
    assert str(citation["version"]) == version
    assert citation["license"] == "Apache-2.0"


def test_commit_hooks_use_the_tools_of_make_lint_and_fetch_nothing():
    config = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    assert [repository["repo"] for repository in config["repos"]] == ["local"]
    tools = {hook["entry"].split()[0] for hook in config["repos"][0]["hooks"]}
    lint = (ROOT / "Makefile").read_text().partition("\nlint:")[2].partition("\n\n")[0]
    assert tools == {f".venv/bin/{name}" for name in re.findall(r"\$\(BIN\)/(\S+)", lint)}


@pytest.mark.parametrize(
    ("form", "asks"),
    [("bug_report", {"happened", "version", "arm", "drive", "log"}), ("feature_request", {"problem", "proposal"})],
)
def test_an_issue_form_asks_for_what_is_needed(form, asks):
    body = yaml.safe_load((ROOT / ".github" / "ISSUE_TEMPLATE" / f"{form}.yml").read_text())["body"]
    required = {field["id"] for field in body if field.get("validations", {}).get("required")}
    assert asks <= required


def test_the_licence_is_apache_2():
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License\n                           Version 2.0, January 2004" in text
    assert text.rstrip().endswith("limitations under the License.")


@pytest.mark.parametrize(
    "script", [*sorted((ROOT / "scripts").iterdir()), ROOT / ".ci" / "run"], ids=lambda path: path.name
)
def test_a_shell_script_parses_and_can_be_run(script):
    if script.is_file() and script.read_bytes().startswith(b"#!/usr/bin/env bash"):
        assert script.stat().st_mode & 0o111
        subprocess.run(["bash", "-n", script], check=True)
