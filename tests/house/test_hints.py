"""A hint names a command that works as printed: every `armlink …` in a message parses as a whole, and some are run."""

import ast
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import typer
import yaml

from armlink import cli, completion
from armlink.recording.files import save_recording
from armlink.recording.recording import Recording

ROOT = Path(__file__).parents[2]
COMMANDS = {point.name: point for point in cli.contributions("armlink.commands")}
HINT = re.compile(rf"armlink ((?:{'|'.join(COMMANDS)})\b[^;()`\n]*)")
"""A command up to the end of its sentence; a command that is only mentioned stands without the program's name."""
NO_MESSAGE = {"by", "title"}
"""Keywords whose text says who did something and what it is called."""


def hints() -> Iterator[tuple[str, str]]:
    """Every command line in a string of ours, docstrings apart, with a bundled arm for each value put in."""
    for package in ("armlink", "calib", "gcomp", "sim_bus", "sim_gap"):
        for file in sorted((ROOT / package).rglob("*.py")):
            source = file.read_text()
            if not re.search(r"armlink (?!import\b)", source):
                continue
            tree = ast.parse(source)
            nodes = list(ast.walk(tree))
            apart = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
            apart |= {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
            keywords = [each for node in nodes if isinstance(node, ast.Call) for each in node.keywords]
            apart |= {id(each.value) for each in keywords if each.arg in NO_MESSAGE}
            apart |= {
                id(node.value)
                for node in nodes
                if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "BY"
            }
            for node in nodes:
                for found in HINT.findall("" if id(node) in apart else text(node)):
                    yield str(file.relative_to(ROOT)), found.rstrip(".? ")


def text(node: ast.AST) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "sarcos" for part in node.values)
    return ""


def refusal(words: list[str]) -> str:
    """What the command's own parser says against these words; empty if it takes them."""
    name, *rest = words
    command = completion._command(COMMANDS[name])
    for sub in list(rest):
        inner = getattr(command, "commands", {}).get(sub)
        if inner is None:
            break
        command, rest = inner, rest[1:]
    try:
        command.make_context(name, rest)
    except typer.Exit:  # --help
        return ""
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        return str(error.format_message())
    return ""


def test_every_command_in_a_message_is_whole(capsys):
    found = list(hints())
    assert len(found) > 15
    wrong = {hint: (file, said) for file, hint in found if (said := refusal(hint.split()))}
    assert wrong == {}


def test_it_would_notice_one_that_is_not():
    assert "out" in refusal(shlex.split("gap collect sarcos --motion settle.csv"))
    assert refusal(["verify", "sarcos", "--nope"])


SITUATIONS = [
    (["scan", "arm4.urdf"], []),
    (["new", "arm.yaml"], []),
    (["torque", "arm.yaml", "--q", "q.csv"], ["--plan"]),
    (["recalibrate", "arm.yaml", "run.mcap"], ["--plan"]),
    (["record", "arm.yaml", "run.csv"], []),
    (["history", "arm.yaml", "--activate"], []),
    (["doctor", "silent.yaml"], []),
    (["doctor", "rewired.yaml"], []),
    (["doctor", "arm4.urdf"], []),
    (["gap", "plan", "arm.yaml", "--joint", "elbow", "--poses", "1", "--out", "settle.csv"], ["--help"]),
]
"""Commands that end with a hint, and what is added to it so that no arm is swept here."""


@pytest.mark.parametrize(("words", "more"), SITUATIONS, ids=lambda each: "-".join(each))
def test_what_a_message_names_is_typed_as_it_stands(words, more, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("COLUMNS", "400")
    content = yaml.safe_load((ROOT / "examples" / "planar3.yaml").read_text())
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(content))
    content["link"]["bus"] = {"interface": "armlink_sim", "channel": "arm.yaml"}
    content["link"]["joints"][0]["node"] = 77
    (tmp_path / "rewired.yaml").write_text(yaml.safe_dump(content))
    content["link"]["bus"] = {"interface": "pcan", "channel": "PCAN_USBBUS9"}
    (tmp_path / "silent.yaml").write_text(yaml.safe_dump(content))
    (tmp_path / "arm4.urdf").write_text((ROOT / "tests" / "models" / "arm4.urdf").read_text())
    (tmp_path / "q.csv").write_text("q_1,q_2,q_3\n0,0,0\n")
    save_recording(Recording(t=np.arange(9) * 0.1, position=np.zeros((9, 3)), torque=np.ones((9, 3))), "run.mcap")
    cli.run(words)
    out, err = capsys.readouterr()
    (hint,) = set(HINT.findall(out + err))
    assert cli.run([*shlex.split(hint), *more]) in (0, 1), hint
