"""Messages in the column "the user reads" of the documentation's tables stand in the source, clause by clause.

`…` and values in a quotation, and placeholders in the source, stand for anything.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
COLUMN = "the user reads"
VALUE = re.compile(r"`[^`]*`|\S*[\d_…]\S*( [a-z]\b)?")
"""A value with its unit, a name of this arm, or what is left out."""
PROSE = re.compile(r"(status|log|event|detail|after|as|then|or|one line|the same)\b[^:]*(: |$)|(nothing|if|429|\*).*")
"""What introduces a message, or stands in place of one."""
SYSTEM = ("Network is down", "attempt to write a readonly database", "connection timeout expired")
"""Texts of libraries."""


def quoted() -> Iterator[str]:
    """Clauses of three words or more, between the values of each cell below `COLUMN`."""
    for page in sorted((ROOT / "docs").rglob("*.md")):
        column = None
        for line in page.read_text(encoding="utf-8").splitlines():
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if not line.startswith("|"):
                column = None
            elif COLUMN in cells:
                column = cells.index(COLUMN)
            elif column is not None:
                for part in re.split(r"; (?=then|or|after)|, (?=or:|if)", cells[column]):
                    message = part[found.end() :] if (found := PROSE.match(part)) else part
                    clauses = re.split(r"[…:;,()]", VALUE.sub("…", message))
                    yield from (clause for each in clauses if (clause := each.strip(" .-–*'\"")).count(" ") >= 2)


def source() -> str:
    """Every string of the packages, a line each."""
    files = [file for package in ("armlink", "calib") for file in (ROOT / package).rglob("*.py")]
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))]
    texts = [node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    joined = [node.values for node in nodes if isinstance(node, ast.JoinedStr)]
    texts += ["".join(str(each.value) if isinstance(each, ast.Constant) else "…" for each in parts) for parts in joined]
    return VALUE.sub("…", "\n".join(texts))


def stands_in(text: str, clause: str) -> bool:
    """Whether a text has this clause, some words of which in a row may be a placeholder's value."""
    words = clause.split()
    ends = [(i, j) for i in range(len(words) + 1) for j in range(i, len(words) + 1) if j - i <= len(words) - 2]
    return clause in SYSTEM or any(" ".join([*words[:i], *["…"][: j - i], *words[j:]]) in text for i, j in ends)


def test_quoted_messages_stand_in_the_source() -> None:
    clauses, text = list(quoted()), source()
    assert len(clauses) > 100
    assert [each for each in clauses if not stands_in(text, each)] == []
    assert not stands_in(text, "its power remains off")
