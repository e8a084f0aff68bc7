"""The notebooks run, are short, and hold no output."""

import json
import shutil
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
"""In the order in which they build on one another: identify takes the sweeps of calibrate."""
MOST_LINES = 12
SAYS = {"calibrate": "elbow: gain", "identify": "allowed", "diagnose": "friction.coulomb"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """One for all notebooks, with the examples beside it, whose arm has fewer cycles and shorter averages here."""
    root = tmp_path_factory.mktemp("project")
    shutil.copytree(ROOT / "examples", root / "examples")
    arm = root / "examples" / "planar3.yaml"
    text = arm.read_text().replace("rate: 250", "rate: 50")
    arm.write_text(text.replace("{steps: 5, poses: 1}", "{steps: 5, poses: 1, gain_std: 0.01, acceleration: 10.0}"))
    (root / "notebooks").mkdir()
    return root / "notebooks"


def code(notebook: Path) -> list[str]:
    cells = json.loads(notebook.read_text())["cells"]
    assert all(not cell.get("outputs") for cell in cells)
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_there_is_one_for_each_task():
    assert {each.stem for each in NOTEBOOKS} == SAYS.keys()


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda each: each.stem)
def test_it_is_short(notebook):
    lines = [line for cell in code(notebook) for line in cell.splitlines() if line.strip()]
    assert len(lines) <= MOST_LINES


@pytest.mark.parametrize(
    "notebook",
    [pytest.param(each, marks=[] if each.stem == "diagnose" else pytest.mark.long) for each in NOTEBOOKS],
    ids=lambda each: each.stem,
)
def test_it_runs(notebook, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    names: dict[str, object] = {}
    for cell in code(notebook):
        exec(compile(cell, str(notebook), "exec"), names)
    assert SAYS[notebook.stem] in capsys.readouterr().out
