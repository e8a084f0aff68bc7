"""Small files that are written whole or not at all."""

import os
from pathlib import Path


def part_of(path: Path) -> Path:
    """What the file is called while it is being written."""
    return path.with_name(path.name + ".part")


def write_whole(path: Path, text: str) -> None:
    """Write a text file that has its name only once it is on disk; raises OSError."""
    with part_of(path).open("w", encoding="utf-8") as part:
        part.write(text)
        part.flush()
        os.fsync(part.fileno())
    part_of(path).replace(path)
