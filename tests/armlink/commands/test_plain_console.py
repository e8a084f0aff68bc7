"""Sentences are broken between words on a terminal alone and never read as styles; tables fit the width; nothing in a
name acts on the terminal.
"""

import ast
import io
import json
import logging
import re
import sys
import unicodedata
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rich.console import Group
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from armlink import cli
from armlink.commands.plain_console import PlainColumn, PlainConsole, suggest
from armlink.content.printable_text import PrintableFormatter, printable_json, printable_text, wrap_text
from calib.daemon.logs import JsonFormatter

COMMAND = (
    "next: armlink sweep arm.yaml --bus udp_multicast:239.74.163.2 --reference-mass 1.9 --out path/of[bold]/loaded"
)
HOSTILE = (
    "[red]elbow[/red]",
    "[link=https://example.org]elbow[/link]",
    "[/nothing]",
    "[bold",
    ":warning: elbow",
    "\x1b[2J\x1b]8;;https://example.org\x1b\\elbow",
    "\x9b2J",
    "elbow\rwrist",
    "elbow\narmlink: all checks passed",
    "elbow\u202egnp.exe",
    "\u2066elbow\u2069",
    "\x07\x08\x7f",
    "a\u2028b\u2029c\x85d",
)
NAMES = st.one_of(st.sampled_from(HOSTILE), st.text(st.characters(exclude_categories=["Cs"]), max_size=30))
ROOT = Path(__file__).parents[3]


@pytest.fixture(autouse=True)
def _narrow(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")


def shown(act, width: int = 400) -> str:
    """What a console shows on a file that is no terminal."""
    console = PlainConsole()
    console.file, console.width = io.StringIO(), width
    act(console)
    return console.file.getvalue()


def is_harmless(text: str) -> bool:
    return all(each.isprintable() or each == "\n" or unicodedata.category(each) == "Zs" for each in text)


def test_a_command_comes_in_one_piece_with_its_brackets(capsys):
    PlainConsole().print(COMMAND, style="bold")
    assert capsys.readouterr().err == f"{COMMAND}\n"


SENTENCE = (
    "j2s6s200_joint_1 has no limits: give its stops with `--stops j2s6s200_joint_1:-2.1:2.1`, or Enter for a range of "
    "2.9 rad to either side"
)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_sentence_is_broken_between_words_on_a_terminal_and_nowhere_else(capsys):
    console = PlainConsole()
    console.file, console.width = Terminal(), 60
    console.print(SENTENCE, style="yellow")
    lines = re.sub(r"\x1b\[[0-9;]*m", "", console.file.getvalue()).splitlines()
    assert len(lines) == 3
    assert max(map(len, lines)) <= 60
    assert " ".join(lines) == SENTENCE
    assert "`--stops j2s6s200_joint_1:-2.1:2.1`" in lines[1], "a command comes in one piece"
    PlainConsole().print(SENTENCE)
    assert capsys.readouterr().err == f"{SENTENCE}\n"


def test_the_next_command_is_not_broken_on_a_terminal(monkeypatch):
    monkeypatch.setattr("sys.stderr", Terminal())
    suggest(COMMAND.removeprefix("next: "))
    assert COMMAND in sys.stderr.getvalue()


def test_an_error_and_the_list_of_commands_are_broken_between_words_on_a_terminal(monkeypatch):
    for stream in ("stdout", "stderr"):
        monkeypatch.setattr(f"sys.{stream}", Terminal())
    assert cli.run(["--help"]) == 0
    assert max(map(len, sys.stdout.getvalue().splitlines())) <= 62, "a line of options"
    cli._fail(SENTENCE, 2)
    assert " ".join(sys.stderr.getvalue().splitlines()) == f"armlink: {SENTENCE}"
    assert max(map(len, sys.stderr.getvalue().splitlines())) <= 60


@given(st.text(st.sampled_from("ab `"), max_size=60), st.integers(1, 40))
def test_wrapping_turns_single_spaces_into_breaks(text, width):
    lines = wrap_text(text, width).split("\n")
    assert " ".join(lines) == text
    for line in lines:
        assert len(line) <= width or not re.search(r"^[^ `]+ +[^ `]+", line), "longer only where it cannot be broken"


def test_a_table_fits_the_width(capsys):
    table = Table("joint", "why")
    table.add_row("j1", "words " * 30)
    PlainConsole().print(table)
    assert max(map(len, capsys.readouterr().err.splitlines())) <= 60


def test_units_in_the_heads_of_tables_stay(capsys):
    PlainConsole().print(Table("joint", "stops [rad]"))
    assert "[rad]" in capsys.readouterr().err


@settings(deadline=None, max_examples=60, derandomize=True)
@given(NAMES)
def test_a_name_is_text_on_every_way_to_the_terminal(name):
    table = Table(name, "state", title=name)
    table.add_row(name, Text(name))
    ways = {
        "sentence": lambda console: console.print(f"{name}: no answer", style="red"),
        "text": lambda console: console.print(Text(name)),
        "group": lambda console: console.print(Group(name, Text(name))),
        "table": lambda console: console.print(table),
        "status": _status(name),
        "progress": _progress(name),
    }
    for way, act in ways.items():
        said = shown(act)
        assert is_harmless(said), (way, said)
    assert shown(ways["sentence"]) == f"{printable_text(name)}: no answer\n"
    assert shown(ways["sentence"]).count("\n") == 1


def _status(name):
    def act(console):
        with console.status(name) as status:
            status.update(name)
            console.print(status.renderable.text)

    return act


def _progress(name):
    def act(console):
        with Progress(PlainColumn("{task.description}"), console=console) as bars:
            bars.add_task(name, total=1)

    return act


@settings(deadline=None, max_examples=60, derandomize=True)
@given(NAMES)
@example("\x1b[2J")
def test_an_error_is_one_harmless_line(name):
    out = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stderr", out)
        cli._fail(f"{name}: no answer", 2)
    assert is_harmless(out.getvalue())
    assert out.getvalue().count("\n") == 1


@settings(deadline=None, max_examples=100, derandomize=True)
@given(NAMES)
def test_lines_of_logs_and_json_are_harmless_and_mean_the_same(name):
    record = logging.LogRecord("armlink", logging.WARNING, "", 0, "%s: silent", (name,), None)
    assert is_harmless(PrintableFormatter().format(record))
    line = JsonFormatter().format(record)
    assert is_harmless(line)
    assert json.loads(line)["message"] == f"{name}: silent"
    assert json.loads(printable_json({name: [name]}, indent=1)) == {name: [name]}
    assert is_harmless(printable_json({name: [name]}, indent=1))


@given(st.text(st.characters(exclude_categories=["C", "Z"]), max_size=30))
def test_printable_text_is_left_as_it_is(text):
    assert printable_text(text) == text
    assert printable_text(f"{text}\u202f{text}\u00a0é") == f"{text}\u202f{text}\u00a0é"


def test_text_reaches_the_terminal_in_one_place():
    """No other module prints, asks, or makes a console or a column of its own."""
    allowed = {"armlink/commands/plain_console.py", "armlink/commands/output.py"}
    forbidden = {
        "typer.echo",
        "typer.confirm",
        "typer.prompt",
        "typer.secho",
        "Console",
        "TextColumn",
        "print",
        "input",
    }
    like = re.compile(rf"\b(?:{'|'.join(each.rpartition('.')[2] for each in forbidden)})\(")
    found = []
    for package in ("armlink", "calib", "gcomp", "sim_bus", "sim_gap"):
        for path in sorted((ROOT / package).rglob("*.py")):
            place, source = str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")
            for node in ast.walk(ast.parse(source)) if like.search(source) else ():
                called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
                if called in forbidden and place not in allowed:
                    found.append(f"{place}:{node.lineno} {called}")
    assert found == []
