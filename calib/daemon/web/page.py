"""The page's own files, read once at the start; nothing else of the disk can be asked for."""

import hashlib
from dataclasses import dataclass
from importlib.resources import files

TYPES = {"html": "text/html; charset=utf-8", "css": "text/css; charset=utf-8", "js": "text/javascript; charset=utf-8"}
TYPES |= {"svg": "image/svg+xml"}


@dataclass(frozen=True)
class PageFile:
    """One file as it is sent."""

    content: bytes
    media_type: str
    etag: str


def page_files() -> dict[str, PageFile]:
    """Path of the URL → file; `/` is index.html."""
    found: dict[str, PageFile] = {}
    for file in files("calib.daemon.web").joinpath("static").iterdir():
        suffix = file.name.rpartition(".")[2]
        if suffix in TYPES:
            content = file.read_bytes()
            etag = f'"{hashlib.sha256(content).hexdigest()[:16]}"'
            path = "/" if file.name == "index.html" else f"/static/{file.name}"
            found[path] = PageFile(content, TYPES[suffix], etag)
    return found
