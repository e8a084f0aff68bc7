"""Sentences are never broken nor read as styles; tables fit the width."""

import pytest
from rich.table import Table

from armlink.commands.plain_console import PlainConsole

COMMAND = (
    "next: armlink sweep arm.yaml --bus udp_multicast:239.74.163.2 --reference-mass 1.9 --out path/of[bold]/loaded"
)


@pytest.fixture(autouse=True)
def _narrow(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")


def test_a_command_comes_in_one_piece_with_its_brackets(capsys):
    PlainConsole().print(COMMAND, style="bold")
    assert capsys.readouterr().err == f"{COMMAND}\n"


def test_a_table_fits_the_width(capsys):
    table = Table("joint", "why")
    table.add_row("j1", "words " * 30)
    PlainConsole().print(table)
    assert max(map(len, capsys.readouterr().err.splitlines())) <= 60


def test_units_in_the_heads_of_tables_stay(capsys):
    PlainConsole().print(Table("joint", "stops [rad]"))
    assert "[rad]" in capsys.readouterr().err
