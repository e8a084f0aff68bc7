"""The public API: names, signatures, kinds of arguments, types for a user's script, a page of the site."""

import inspect
import re
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest

import armlink
from armlink.errors import BadInput

ROOT = Path(__file__).parents[2]
SIGNATURES = {
    "load_arm": "(arm)",
    "load_recording": "(path, stated=None)",
    "open_link": "(arm, bus=None, *, simulated=False, load=0.0)",
    "sweep": "(arm, out, *, bus=None, simulated=False, reference_mass=0.0, resume=False, seed=0, progress=None)",
    "calibrate": "(*sweeps, arm=None)",
    "identify": "(*sweeps, arm=None, sensors=None)",
    "verify": "(arm, gravity, sensors=None, *, bus=None, simulated=False, poses=24, seed=0, progress=None)",
    "observe": "(arm, recording, gravity, sensors, *, config=None)",
    "diagnose": "(model, train, heldout=(), *, base=None, tip=None, units=(), sign=(), zero=(), clock=(), columns=(), "
    "joints=(), effort_is='', topic='')",
}
CLASSES = {"ArmFile", "ArmlinkError", "Recording"}
SCRIPT = """
from pathlib import Path

import armlink

arm: armlink.ArmFile = armlink.load_arm(Path("arm.yaml"))
bare = armlink.sweep(arm, "unloaded", bus="socketcan:can0")
loaded = armlink.sweep("arm.yaml", Path("loaded"), reference_mass=3.0)
sensors = armlink.calibrate(bare, "loaded")
gravity = armlink.identify(bare, loaded, sensors=sensors)
if not armlink.verify(arm, gravity, sensors).passed:
    raise SystemExit(1)
run: armlink.Recording = armlink.load_recording("run.mcap")
for event in armlink.observe(arm, run, gravity, sensors).events:
    print(event.kind, event.joint)
verdict: str = armlink.diagnose("arm.xml", [run, "other.csv"]).verdict
with armlink.open_link(arm) as link:
    reveal_type(link.n)
"""


def test_the_names_are_those_that_the_packages_contribute():
    contributed = {point.name for point in entry_points(group="armlink.api")}
    assert set(armlink.__all__) == contributed == SIGNATURES.keys() | CLASSES
    assert contributed <= set(dir(armlink))
    stub = (ROOT / "armlink" / "__init__.pyi").read_text()
    assert set(re.findall(r"import (\w+) as \1", stub)) == contributed


@pytest.mark.parametrize("name", SIGNATURES)
def test_a_signature_is_stable(name):
    signature = inspect.signature(getattr(armlink, name))
    bare = [each.replace(annotation=inspect.Parameter.empty) for each in signature.parameters.values()]
    found = str(signature.replace(parameters=bare, return_annotation=inspect.Signature.empty))
    assert found == SIGNATURES[name]


@pytest.mark.parametrize("name", sorted(SIGNATURES.keys() | CLASSES))
def test_every_name_has_a_docstring_and_stands_on_a_page(name):
    assert inspect.getdoc(getattr(armlink, name))
    page = (ROOT / "docs" / "reference" / "api.md").read_text()
    assert f"`armlink.{name}`" in page


def test_an_unknown_name_says_what_there_is():
    with pytest.raises(AttributeError, match=r"no attribute 'calibarte'; it offers .*calibrate"):
        _ = armlink.calibarte


@pytest.mark.parametrize("kind", [str, Path])
def test_paths_are_text_or_path(kind, tmp_path):
    arm = armlink.load_arm(kind(ROOT / "examples" / "planar3.yaml"))
    with armlink.open_link(kind(arm.path), simulated=True) as link:
        assert link.names == arm.joint_names
    run = armlink.Recording(t=np.arange(3) * 0.1, position=np.zeros((3, 3)), torque=np.ones((3, 3)))
    from armlink.recording.files import save_recording

    save_recording(run, kind(tmp_path / "run.csv"))
    assert armlink.load_recording(kind(tmp_path / "run.csv")).n == 3


def test_an_open_link_takes_no_bus(tmp_path):
    with (
        armlink.open_link(ROOT / "examples" / "planar3.yaml", simulated=True) as link,
        pytest.raises(armlink.ArmlinkError, match="the given link is already open"),
    ):
        armlink.sweep(link, tmp_path / "unloaded", bus="socketcan:can0")


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: armlink.open_link(3), "arm: expected an ArmFile, a path, or the name of a bundled arm, not int"),
        (lambda: armlink.open_link("sarcos", "socketcan:vcan0", simulated=True), "leave out `bus` or `simulated`"),
        (lambda: armlink.open_link("sarcos", load=2.0), "only a simulated arm"),
        (lambda: armlink.calibrate(), "give at least one data set that `sweep` wrote"),
        (lambda: armlink.calibrate(["a", "b"]), "each as a separate argument, not list"),
        (lambda: armlink.identify("nosuch"), "nosuch"),
        (lambda: armlink.diagnose("sarcos", 3), "diagnose: train: expected recordings or their paths, not int"),
        (lambda: armlink.diagnose("sarcos", [None]), "not NoneType"),
        (lambda: armlink.diagnose("sarcos", "gone.csv"), "gone.csv"),
        (lambda: armlink.load_arm("sarocs"), "did you mean sarcos?"),
    ],
)
def test_a_wrong_kind_is_one_line(call, says):
    with pytest.raises(armlink.ArmlinkError) as caught:
        call()
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.long
def test_a_user_s_script_passes_mypy_strict(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--config-file=", "script.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("script.py") and "error" in line]
    assert lines == [], done.stdout
    assert 'Revealed type is "int"' in done.stdout.replace("builtins.", "")


def test_a_sweep_with_a_mass_that_no_drive_holds_is_refused_before_anything_is_opened(tmp_path):
    with pytest.raises(BadInput, match=r"attach at most 13 kg; or do you mean 5 kg\?"):
        armlink.sweep("sarcos", tmp_path / "loaded", simulated=True, reference_mass=5000.0)
    assert not (tmp_path / "loaded").exists()
