"""Extras: what is installed on request (pyproject.toml), and the error that names what is missing of one."""

import re
import shlex
import sys
from collections.abc import Iterator
from importlib.metadata import requires
from importlib.util import find_spec

from armlink.errors import BadInput

COLLECTIONS = ("all", "demo", "dev")
"""Extras that only collect others."""
REQUIREMENT = re.compile(r"""(?P<package>(?P<name>[\w-]+)[^;\s]*)\s*;\s*extra\s*==\s*['"](?P<extra>[\w-]+)['"]""")

MODULES = {"gs_usb": "usb", "pyserial": "serial"}
"""Package → its top module, or that of what it is made of (gs_usb imports any time, but needs pyusb)."""


def require_extra(purpose: str, *extras: str) -> None:
    """Raise BadInput that names the extra where it is missing: asked before work begins whose end needs it."""
    for extra, module, _ in _modules():
        if extra in extras and not _is_installed(module):
            raise BadInput(_missing(purpose, module, extra))


def has_extra(extra: str) -> bool:
    return all(_is_installed(module) for each, module, _ in _modules() if each == extra)


def missing_extra(purpose: str, module: str) -> str | None:
    """The same line for a module that could not be imported; None where no extra of ours brings it."""
    wanted = module.partition(".")[0]
    extra = next((each for each, known, _ in _modules() if known == wanted and each not in COLLECTIONS), None)
    return None if extra is None else _missing(purpose, module, extra)


def _missing(purpose: str, module: str, extra: str) -> str:
    """Names the packages themselves, for this interpreter: armlink need not be on an index, nor pip on the path."""
    packages = [package for each, known, package in _modules() if each == extra and not _is_installed(known)]
    remedy = shlex.join([sys.executable, "-m", "pip", "install", *packages])
    return f"{purpose}: {module} (extra {extra}) is not installed: {remedy}"


def _modules() -> Iterator[tuple[str, str, str]]:
    """Extras, each with its top modules, which are named like their packages but for a suffix, and with these."""
    for requirement in requires("armlink") or []:
        found = REQUIREMENT.match(requirement)
        if found and found["name"] != "armlink":
            module = found["name"].lower().replace("-", "_").removesuffix("_sdk")
            yield found["extra"], MODULES.get(module, module), found["package"]


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:
        return False
