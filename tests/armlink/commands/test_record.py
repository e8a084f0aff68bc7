"""`armlink record`: where it may write to."""

import pytest

from armlink.cli import run


@pytest.mark.parametrize("name", ["run.csv", "run", "run.MCAP"])
def test_another_format_is_converted_to_afterwards(name, tmp_path, capsys):
    assert run(["record", "sarcos", str(tmp_path / name), "--bus", "virtual:test-record", "--seconds", "0.01"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "record writes .mcap files: record " in line
    assert not list(tmp_path.iterdir())


def test_the_format_of_its_own_is_taken(tmp_path, capsys):
    assert (
        run(["record", "sarcos", str(tmp_path / "run.mcap"), "--bus", "virtual:test-record", "--seconds", "0.01"]) == 3
    )
    assert "record writes .mcap files" not in capsys.readouterr().err
