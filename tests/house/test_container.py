"""The container file: what it copies is there and suffices for the wheel, and its command is one that armlink takes."""

import json
import re
import tomllib
from pathlib import Path

import pytest

from armlink import cli

ROOT = Path(__file__).parents[2]
LINES = (ROOT / "packaging" / "Containerfile").read_text().splitlines()


def test_what_it_copies_is_what_the_wheel_is_made_of() -> None:
    copied = {name for line in LINES if re.match(r"COPY (?!--from)", line) for name in line.split()[1:-1]}
    assert [name for name in sorted(copied) if not (ROOT / name).exists()] == []
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    needed = {*project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"], "pyproject.toml"}
    needed |= {project["project"]["readme"], *project["project"]["license-files"]}
    assert needed | {"requirements.lock"} == copied
    let_in = (ROOT / ".dockerignore").read_text().split()
    assert {f"!{name}" for name in copied} == {line for line in let_in if line.startswith("!")}


def test_its_command_is_one_that_armlink_takes(capsys: pytest.CaptureFixture[str]) -> None:
    entry, command = (json.loads(line.split(maxsplit=1)[1]) for line in LINES if line.startswith(("ENTRYPOINT", "CMD")))
    assert entry == ["armlink", "daemon"]
    assert cli.run(["daemon", "--help"]) == 0
    shown = capsys.readouterr().out
    options = [word for word in command if word.startswith("--")]
    assert [word for word in options if not re.search(rf"{word}\b(?!-)", shown)] == []
    assert command[command.index("--tcp") + 1].startswith(
        "127.0.0.1:"
    )  # not on the network, where TCP is not encrypted
    assert "USER armlink" in LINES
