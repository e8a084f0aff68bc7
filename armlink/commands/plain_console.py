"""What commands say to people, on standard error."""

from typing import Any

from rich.console import Console


class PlainConsole(Console):
    """Sentences come as they are and unbroken, so that a command in one can be pasted; tables fit the width."""

    def __init__(self, markup: bool = True) -> None:
        """`markup`: whether tables read square brackets as styles; sentences never do, unless `print` is told."""
        super().__init__(stderr=True, markup=markup)

    def print(self, *objects: Any, **options: Any) -> None:
        """As rich has it."""
        if all(isinstance(each, str) for each in objects):
            options = {"markup": False, "highlight": False, "soft_wrap": True} | options
        super().print(*objects, **options)
