"""The pages from sweeps to observer, each command in its order, in lock-step on a short arm: a sample of `make walk`.

The bus is in each command's own process, so the arm is a new one every time: what must find the arm as the command
before left it (verify), and what needs recordings or real time, is left to `make walk`.
"""

import json
import re
import shlex
import sys
from pathlib import Path

import pytest

from armlink import cli

sys.path.append(str(Path(__file__).parent.parent / "campaigns"))
from docs_walk import LEFT_OUT, NEW, OLD, PAGES, left_out, lines_of
from small_pair import describe

IN_LOCK_STEP = ("sweeps", "records", "observer")
MAY_REFUSE = ("armlink recalibrate",)
"""With sensors that have no noise the record from both passes predicts better than one from the first pass alone."""
NOT_HERE = ("armlink verify", "armlink check", "armlink recalibrate my-arm.yaml slow.mcap")


def test_every_reason_to_leave_a_line_out_is_needed() -> None:
    lines = [line for page in PAGES for line in lines_of(page)]
    assert all(any(line.startswith(begin) for line in lines) for begin in LEFT_OUT)
    assert all(line.startswith(("armlink ", "curl ")) for line in lines if not left_out(line)), lines


def test_the_commands_of_the_pages_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    text = describe(tmp_path, rate=50, bus={"interface": "armlink_sim", "channel": "my-arm.yaml"}).read_text()
    (tmp_path / "my-arm.yaml").write_text(text)

    def armlink(line: str) -> None:
        command, _, target = line.partition(" > ")
        status = cli.run(shlex.split(command)[1:])
        said = capsys.readouterr()
        assert status == 0 or (status == 1 and line.startswith(MAY_REFUSE)), f"{line}: {said.err}"
        if target:
            Path(target).write_text(said.out)

    def ids() -> tuple[str, str]:
        armlink("armlink history my-arm.yaml --json ids.json")
        kept = [each for each in json.loads(Path("ids.json").read_text())["records"] if each["kind"] == "calibration"]
        return kept[0]["id"], next(each["id"] for each in kept if each["current"])

    for page in IN_LOCK_STEP:
        if page == "records":
            armlink(f"armlink history my-arm.yaml --record {ids()[0]} > last-year.yaml")
        for line in lines_of(page):
            if left_out(line) or line.startswith(NOT_HERE):
                continue
            here = re.sub(r"\bsarcos\b", "my-arm.yaml", line)
            if OLD in here or NEW in here:
                old, new = ids()
                here = here.replace(OLD, old).replace(NEW, new)
            armlink(f"{here} --dry-run" if "--reference-mass" in here else here)  # which hangs the mass on the arm
