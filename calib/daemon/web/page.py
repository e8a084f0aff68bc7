"""The page: one HTML document with its style and script inside, assembled from `static/` once at the start.

It takes a single round trip even on a slow network, and no other file of the disk can be requested.
"""

import base64
import hashlib
import re
from dataclasses import dataclass
from importlib.resources import files

CSP = (
    "default-src 'none'; script-src '{script}'; style-src '{style}'; img-src data:; connect-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Only this script and this style run, by their SHA-256."""
_IMPORT = re.compile(r'^import .* from "\./(.*)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export ", re.MULTILINE)


@dataclass(frozen=True)
class PageFile:
    content: bytes
    media_type: str
    etag: str
    policy: str
    """Header content-security-policy."""


def page_files() -> dict[str, PageFile]:
    """URL path → file; there is only `/`."""
    script, style = joined("page.js"), _static("page.css")
    icon = base64.b64encode(_static("icon.svg").encode()).decode()
    page = _static("index.html").replace("ICON", f"data:image/svg+xml;base64,{icon}")
    page = page.replace("/* STYLE */", style).replace("/* SCRIPT */", script)
    content = page.encode()
    policy = CSP.format(script=_hash(script), style=_hash(style))
    etag = f'"{hashlib.sha256(content).hexdigest()[:16]}"'
    return {"/": PageFile(content, "text/html; charset=utf-8", etag, policy)}


def joined(name: str) -> str:
    """A module of `static/` and everything that it imports, each once and before its users, as one module.

    They share one scope: the same top-level name in two of them is an error that the browser reports.
    """
    order: list[str] = []

    def visit(module: str) -> None:
        for other in _IMPORT.findall(_static(module)):
            visit(other)
        if module not in order:
            order.append(module)

    visit(name)
    return "".join(_EXPORT.sub("", _IMPORT.sub("", _static(module))) for module in order)


def _static(name: str) -> str:
    return files("calib.daemon.web").joinpath("static", name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
