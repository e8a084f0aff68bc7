"""Reads docs/formats.md: its numbered sections and the rows of their tables."""

import re
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "sim_gap")]  # importlib leaves them out
PAGE = (Path(__file__).parent.parent.parent / "docs" / "formats.md").read_text(encoding="utf-8")


def part(number: str) -> str:
    """Text of a numbered section, its own sub-sections included."""
    found = re.search(rf"^(#+) {re.escape(number)}\.? .*$", PAGE, re.MULTILINE)
    assert found, f"no section {number}"
    rest = PAGE[found.end() :]
    end = re.search(rf"^#{{1,{len(found[1])}}} ", rest, re.MULTILINE)
    return rest[: end.start()] if end else rest


def rows(number: str) -> list[dict[str, str]]:
    """Rows of a section's tables, by column heading."""
    found, heading = [], []
    for line in part(number).splitlines():
        if not line.startswith("|"):
            heading = []
            continue
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if not heading:
            heading = cells
        elif not set(line) <= set("|-: "):
            assert len(cells) == len(heading), line
            found.append(dict(zip(heading, cells, strict=True)))
    return found


def keyed(number: str) -> dict[str, dict[str, str]]:
    """Rows of the tables that have a column `key`, by key; each stands once."""
    found = [(row["key"].strip("`"), row) for row in rows(number) if "key" in row]
    assert len({key for key, _ in found}) == len(found), number
    return dict(found)
