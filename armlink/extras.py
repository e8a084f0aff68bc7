"""Extras: what is installed on request (pyproject.toml), and the error that names the one that is missing."""

import re
from collections.abc import Iterator
from importlib.metadata import requires
from importlib.util import find_spec

from armlink.errors import BadInput

COLLECTIONS = ("all", "demo", "dev")
"""Extras that only collect others."""
REQUIREMENT = re.compile(r"""(?P<name>[\w-]+).*;\s*extra\s*==\s*['"](?P<extra>[\w-]+)['"]""")


def require_extra(purpose: str, *extras: str) -> None:
    """Raise BadInput that names the extra where it is missing: asked before work begins whose end needs it."""
    for extra, module in _modules():
        if extra in extras and not _is_installed(module):
            raise BadInput(_missing(purpose, module, extra))


def has_extra(extra: str) -> bool:
    return all(_is_installed(module) for each, module in _modules() if each == extra)


def missing_extra(purpose: str, module: str) -> str | None:
    """The same line for a module that could not be imported; None where no extra of ours brings it."""
    wanted = module.partition(".")[0]
    extra = next((each for each, known in _modules() if known == wanted and each not in COLLECTIONS), None)
    return None if extra is None else _missing(purpose, module, extra)


def _missing(purpose: str, module: str, extra: str) -> str:
    return f"{purpose}: {module} is not installed: pip install 'armlink[{extra}]'"


def _modules() -> Iterator[tuple[str, str]]:
    """Extras, each with the top modules that it brings, which are named like their packages but for a suffix."""
    for requirement in requires("armlink") or []:
        found = REQUIREMENT.match(requirement)
        if found and found["name"] != "armlink":
            yield found["extra"], found["name"].lower().replace("-", "_").removesuffix("_sdk")


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:
        return False
