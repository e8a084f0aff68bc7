"""scripts/changelog-entry: Unreleased becomes the part of a version, which the workflow finds by its heading."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BEFORE = "# Changelog\n\n## [Unreleased]\n\n### Added\n- A thing.\n\n## 0.1.0 – 2026-01-01\n\n- The first.\n"


def entry(path: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "scripts" / "changelog-entry"), *words, "--file", str(path)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_what_was_unreleased_is_the_version_s_part_and_the_workflow_finds_it(tmp_path: Path) -> None:
    path = tmp_path / "CHANGELOG.md"
    path.write_text(BEFORE)
    assert entry(path, "0.2.0", "--date", "2026-11-22").returncode == 0
    after = path.read_text()
    assert after == BEFORE.replace("## [Unreleased]\n", "## [Unreleased]\n\n## 0.2.0 – 2026-11-22\n")
    workflow = (ROOT / ".github" / "workflows" / "release.yml").read_text()
    (awk,) = (line.strip() for line in workflow.splitlines() if "awk -v start" in line)
    command = f"version=0.2.0; {awk.replace('CHANGELOG.md', str(path)).replace('> notes.md', '')}"
    found = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "### Added\n- A thing."


@pytest.mark.parametrize(
    ("version", "text", "why"),
    [
        ("0.1.0", BEFORE, "0.1.0 has an entry already"),
        ("next", BEFORE, "version next: expected three numbers"),
        ("0.2.0", BEFORE.replace("- A thing.\n", ""), "nothing is under Unreleased"),
        ("0.2.0", "# Changelog\n", "expected one heading"),
    ],
)
def test_otherwise_nothing_changes_and_one_line_says_why(tmp_path: Path, version: str, text: str, why: str) -> None:
    path = tmp_path / "CHANGELOG.md"
    path.write_text(text)
    done = entry(path, version)
    assert done.returncode == 1
    assert why in done.stderr
    assert done.stderr.count("\n") == 1
    assert path.read_text() == text


def test_the_project_s_own_changelog_takes_an_entry(tmp_path: Path) -> None:
    path = tmp_path / "CHANGELOG.md"
    path.write_text((ROOT / "CHANGELOG.md").read_text())
    assert entry(path, "99.0.0").returncode == 0
