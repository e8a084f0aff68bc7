"""The locks: every dependency that pyproject.toml names, at the versions of constraints.txt, each file by its hash."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = {
    "requirements.lock": ("bags", "cluster", "daemon", "parquet", "reports", "simulator", "postgresql"),
    "requirements-dev.lock": ("dev",),
}
HASH = re.compile(r"--hash=sha256:[0-9a-f]{64}\b")


def pinned(name: str) -> dict[str, tuple[set[str], int]]:
    """Package → its versions (one for each environment), and how many hashes they have."""
    found: dict[str, tuple[set[str], int]] = {}
    for entry in re.split(r"\n(?=[A-Za-z0-9])", (ROOT / name).read_text()):
        pin = re.match(r"([A-Za-z0-9._-]+)(?:\[[^]]*])?==([^\s;]+)", entry)
        if pin:
            versions, hashes = found.get(canonicalize_name(pin[1]), (set(), 0))
            found[canonicalize_name(pin[1])] = versions | {pin[2]}, hashes + len(HASH.findall(entry))
    return found


@pytest.mark.parametrize("name", EXTRAS)
def test_every_dependency_is_locked_with_hashes(name: str) -> None:
    locked, extras = pinned(name), PROJECT["optional-dependencies"]
    asked = [*PROJECT["dependencies"], *(line for extra in EXTRAS[name] for line in extras[extra])]
    for requirement in map(Requirement, asked):
        if requirement.name != "armlink":
            versions, _ = locked[canonicalize_name(requirement.name)]
            assert all(requirement.specifier.contains(version) for version in versions), requirement
    assert [package for package, (_, hashes) in locked.items() if not hashes] == []


@pytest.mark.parametrize("name", EXTRAS)
def test_the_locks_have_the_versions_that_the_tests_ran_with(name: str) -> None:
    tested = pinned("constraints.txt")
    locked = pinned(name)
    assert len(locked) > 50
    assert {
        package for package, (versions, _) in locked.items() if versions != tested.get(package, (versions, 0))[0]
    } == set()


def test_an_audit_that_reaches_no_database_says_so_in_one_line_and_fails(tmp_path: Path) -> None:
    lock = tmp_path / "small.lock"
    lock.write_text("jinja2==2.10 --hash=sha256:" + "f" * 64 + "\n")
    nowhere = {**os.environ, "HTTPS_PROXY": "http://127.0.0.1:9", "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run([ROOT / "scripts" / "audit", lock], env=nowhere, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(f"audit: {lock}: not checked: ")
    assert (done.stderr.count("\n"), done.stdout) == (1, "")


def test_the_bill_of_materials_names_what_the_lock_pins(tmp_path: Path) -> None:
    (line,) = (line for line in (ROOT / "Makefile").read_text().splitlines() if "cyclonedx_py" in line)
    words = line.split()[1:]
    words[words.index("-o") + 1] = str(tmp_path / "bill.json")
    words.append("--no-validate")  # the schema takes ten times as long as the rest
    subprocess.run([sys.executable, *words], cwd=ROOT, check=True, capture_output=True)
    bill = json.loads((tmp_path / "bill.json").read_text())
    assert bill["bomFormat"] == "CycloneDX"
    assert bill["metadata"]["component"]["name"] == "armlink"
    named = {(canonicalize_name(each["name"]), each["version"]) for each in bill["components"]}
    locked = pinned("requirements.lock")
    assert named == {(package, version) for package, (versions, _) in locked.items() for version in versions}
