"""Sealing: answers are hashed before a label is opened; labels are read only if the hashes match."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from armlink.errors import BadInput, Refused

MANIFEST = "manifest.json"
SCHEMA = "armlink.blind-seal/1"


def write_answer(folder: Path, name: str, answer: Mapping[str, Any]) -> None:
    """Write one answer as `folder/NAME.json`. Raises Refused once the folder is sealed."""
    if (folder / MANIFEST).exists():
        raise Refused(f"{folder}: answers are sealed, answer {name} is too late: use another folder")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(answer, indent=1, ensure_ascii=False), encoding="utf-8")


def seal(folder: Path) -> str:
    """Hash every answer into `folder/manifest.json` and return the manifest's own SHA-256 (hex)."""
    if (folder / MANIFEST).exists():
        raise Refused(f"{folder}: answers are sealed already")
    hashes = _hashes(folder)
    if not hashes:
        raise BadInput(f"{folder}: no answers to seal")
    content = json.dumps({"schema": SCHEMA, "sha256": hashes}, indent=1, sort_keys=True)
    (folder / MANIFEST).write_text(content, encoding="utf-8")
    return hashlib.sha256(content.encode()).hexdigest()


def verify(folder: Path, digest: str | None = None) -> dict[str, dict[str, Any]]:
    """The sealed answers by name.

    Raises Refused if an answer was changed, added or removed, or the manifest's own SHA-256 is not `digest`.
    """
    manifest = folder / MANIFEST
    if not manifest.is_file():
        raise Refused(f"{folder}: answers are not sealed: seal them before opening the labels")
    content = manifest.read_bytes()
    if digest is not None and hashlib.sha256(content).hexdigest() != digest:
        raise Refused(f"{manifest}: not the manifest that was sealed")
    sealed, now = json.loads(content)["sha256"], _hashes(folder)
    for name in sorted(set(sealed) | set(now)):
        if sealed.get(name) != now.get(name):
            what = "was removed" if name not in now else "was added" if name not in sealed else "was changed"
            raise Refused(f"{folder / name}: {what} after sealing")
    return {name.removesuffix(".json"): json.loads((folder / name).read_text(encoding="utf-8")) for name in sealed}


def open_labels(answers: Path, labels: Path, digest: str | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Answers and labels, both by name; the seal is checked first. Raises Refused."""
    sealed = verify(answers, digest)
    truths = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(labels.glob("*.json"))]
    return sealed, {truth["case"]: truth for truth in truths}


def _hashes(folder: Path) -> dict[str, str]:
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob("*.json"))
        if path.name != MANIFEST
    }
