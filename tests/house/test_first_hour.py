"""The transcripts of docs/first-hour.md, typed: every command ends well, and every line of its output comes."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "first-hour.md"
BLOCKS = re.findall(r"^```console\n\$ (.*)\n((?:.*\n)*?)```$", PAGE.read_text(), re.MULTILINE)


def squeezed(text: str) -> str:
    return " ".join(text.split())


@pytest.mark.slow
def test_the_transcripts_are_what_happens(tmp_path):
    shutil.copy(ROOT / "tests" / "models" / "arm4.urdf", tmp_path)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "XDG_STATE_HOME": str(tmp_path / "state"), "COLUMNS": "200"}
    assert [command.split()[1] for command, _ in BLOCKS] == ["new", "doctor", "demo"]
    for command, shown in BLOCKS:
        done = subprocess.run(
            command.split(),
            cwd=tmp_path,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        said = squeezed(done.stderr)
        for line in shown.splitlines():
            assert squeezed(line) in said, f"{command}: {line}\n{done.stderr}"
    assert (tmp_path / "armlink-demo" / "report.html").stat().st_size > 10_000
