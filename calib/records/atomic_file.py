"""Atomic writes of small text files."""

import os
from pathlib import Path


def part_of(path: Path) -> Path:
    """Path of the file while it is being written."""
    return path.with_name(path.name + ".part")


def write_whole(path: Path, text: str) -> None:
    """Write a text file atomically: it gets its name once it is on disk. Raises OSError."""
    with part_of(path).open("w", encoding="utf-8") as part:
        part.write(text)
        part.flush()
        os.fsync(part.fileno())
    part_of(path).replace(path)
