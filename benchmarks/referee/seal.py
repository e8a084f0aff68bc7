"""The sealed part of a round: labels and held-out recordings, which no process of a tool can read before it answers.

The referee keeps the key in its memory until every answer is written. The hashes of the sealed contents are on disk
from the start, so that nobody can change a label afterwards.
"""

import hashlib
import json
from pathlib import Path
from typing import Any


def cipher(content: bytes, key: bytes, name: str) -> bytes:
    """Content combined with a key stream of SHAKE-256; the same call takes it back."""
    stream = hashlib.shake_256(key + name.encode()).digest(len(content))
    return bytes(a ^ b for a, b in zip(content, stream, strict=True))


def seal(folder: Path, name: str, content: dict[str, Any], key: bytes) -> str:
    """Write `folder/NAME.sealed` and return the SHA-256 of what it holds."""
    plain = json.dumps(content, sort_keys=True).encode()
    (folder / f"{name}.sealed").write_bytes(cipher(plain, key, name))
    return hashlib.sha256(plain).hexdigest()


def opened(folder: Path, name: str, key: bytes, digest: str) -> dict[str, Any]:
    """The sealed content. Raises ValueError if it is not what was sealed."""
    plain = cipher((folder / f"{name}.sealed").read_bytes(), key, name)
    if hashlib.sha256(plain).hexdigest() != digest:
        raise ValueError(f"{folder / name}: this is not what was sealed")
    made: dict[str, Any] = json.loads(plain)
    return made
