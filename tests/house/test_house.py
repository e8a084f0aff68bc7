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

from armlink import cli

ROOT = Path(__file__).parent.parent.parent
COMMANDS = {point.name: point for point in entry_points(group="armlink.commands")}


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
    wanted += [one for extra in project["project"]["optional-dependencies"].values() for one in extra]
    pinned = {name(line) for line in (ROOT / "constraints.txt").read_text().splitlines()}
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
