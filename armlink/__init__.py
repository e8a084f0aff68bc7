"""The wire: CAN frames to samples in SI units and limited commands back; arm file and recordings.

The names in `__all__` are the whole procedure for programs and notebooks (docs/reference/api.md). Each is loaded when
it is first used, by way of the entry points `armlink.api`: the packages above this one contribute theirs, as they do
commands.
"""

from typing import Any

__all__ = [
    "ArmFile",
    "ArmlinkError",
    "Recording",
    "calibrate",
    "diagnose",
    "identify",
    "load_arm",
    "load_recording",
    "observe",
    "open_link",
    "sweep",
    "verify",
]


def __getattr__(name: str) -> Any:
    """A public name, loaded at first use."""
    if name in __all__:
        from armlink.contributed import load_contribution

        if (found := load_contribution("armlink.api", name)) is not None:
            globals()[name] = found
            return found
    raise AttributeError(f"module 'armlink' has no attribute {name!r}; it offers {', '.join(__all__)}")


def __dir__() -> list[str]:
    """Modules that are loaded, and the public names."""
    return sorted({*globals(), *__all__})
