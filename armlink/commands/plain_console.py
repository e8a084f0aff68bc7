"""Text and questions of commands, on standard error: the one way of text to a terminal.

Names come from devices, models and recordings. No text is markup, and what is not printable is shown as its escape,
so that nothing in a name can colour, link, move the cursor, turn the direction of reading or feign a line.
"""

from collections.abc import Iterable
from typing import Any, cast

import typer
from rich.console import Console, RenderableType
from rich.progress import TextColumn
from rich.segment import Segment
from rich.status import Status
from rich.text import Text

from armlink.content.printable_text import printable_text


class PlainConsole(Console):
    """Sentences come as they are and unbroken, so that a command in one can be pasted; tables fit the width."""

    def __init__(self) -> None:
        """On standard error; styles are given as `style` or as rich's `Text`."""
        super().__init__(stderr=True, markup=False, emoji=False)

    def print(self, *objects: Any, **options: Any) -> None:
        """As rich has it."""
        if all(isinstance(each, str) for each in objects):
            options = {"highlight": False, "soft_wrap": True} | options
        super().print(*objects, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Text of a string: of a sentence, a title or a cell, before it is measured."""
        return super().render_str(printable_text(text), **options | {"markup": False, "emoji": False})

    def render(self, renderable: RenderableType, options: Any = None) -> Iterable[Segment]:
        """Segments of anything else, such as a `Text`; rich's own control codes pass."""
        for segment in super().render(renderable, options):
            text, style, control = segment
            if control or text.isprintable() or text == "\n":
                yield segment
            else:
                yield Segment(printable_text(text, keep="\n"), style)

    def status(self, status: RenderableType, **options: Any) -> Status:
        """A spinner with a text beside it."""
        return _PlainStatus(_plain(status), console=self, **options)


class _PlainStatus(Status):
    def update(self, status: RenderableType | None = None, **options: Any) -> None:
        """Replace the text."""
        super().update(None if status is None else _plain(status), **options)


class PlainColumn(TextColumn):
    """A column of a progress bar whose text is no markup."""

    def __init__(self, text_format: str) -> None:
        """`text_format` as rich has it: `{task.description}`."""
        super().__init__(text_format, markup=False)

    def render(self, task: Any) -> Text:
        """The text, measured as it is shown."""
        return _plain(super().render(task).plain)


def confirm(question: str, *, abort: bool = True, default: bool = False) -> bool:
    """The answer to a question of yes or no; raises typer.Abort where it is no and `abort`."""
    return typer.confirm(printable_text(question), abort=abort, default=default, err=True)


def ask(question: str, **options: Any) -> Any:
    """The answer to a question; `options` as of `typer.prompt`."""
    return typer.prompt(printable_text(question), err=True, **options)


def _plain(text: RenderableType) -> Text:
    return Text(printable_text(text)) if isinstance(text, str) else cast(Text, text)
