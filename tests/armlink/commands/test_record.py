"""`armlink record`: where it may write to."""

import pytest

from armlink.cli import run


@pytest.mark.parametrize(("name", "converted"), [("run.csv", True), ("run", False), ("run.MCAP", False)])
def test_another_format_is_converted_to_afterwards(name, converted, tmp_path, capsys):
    assert run(["record", "sarcos", str(tmp_path / name), "--bus", "virtual:test-record", "--seconds", "0.01"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"record writes .mcap files: give {tmp_path / 'run.mcap'}" in line
    assert ("armlink convert" in line) is converted
    assert not list(tmp_path.iterdir())


def test_the_format_of_its_own_is_taken(tmp_path, capsys):
    assert (
        run(["record", "sarcos", str(tmp_path / "run.mcap"), "--bus", "virtual:test-record", "--seconds", "0.01"]) == 3
    )
    assert "record writes .mcap files" not in capsys.readouterr().err
