"""The one way of text to a terminal: results on standard output; progress, hints and questions on standard error.

Names come from devices, models and recordings. No text is markup, and what is not printable is shown as its escape,
so that nothing in a name can colour, link, move the cursor, turn the direction of reading or feign a line.
"""

import contextlib
import os
import shlex
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, cast

import typer
from rich.console import Console, RenderableType
from rich.live import Live
from rich.progress import TextColumn
from rich.segment import Segment
from rich.status import Status
from rich.table import Column, Table
from rich.text import Text

from armlink.commands.fitted_table import fit_table
from armlink.content.printable_text import printable_text, wrap_text
from armlink.errors import Declined

PIPE_WIDTH = 10_000
"""Columns of a pipe or file: no line is broken there, unless the environment says COLUMNS."""
ANSWER_WIDTH = 16
"""Columns of a terminal for what stands behind a question."""
_on_screen: list[Live] = []
"""Spinners and progress bars that are shown now, on any console."""


class PlainConsole(Console):
    """Sentences are broken between words on a terminal and unbroken elsewhere; a command stays whole, so that it can be
    pasted; tables fit the width.

    A console of this class never writes into a spinner or a progress bar of another one.
    """

    def __init__(self, *, stderr: bool = True) -> None:
        """For progress, hints and warnings; for results see `results`. Styles are given as `style` or rich's `Text`."""
        super().__init__(stderr=stderr, markup=False, emoji=False)
        if not self.is_terminal and "COLUMNS" not in os.environ:
            self.width = PIPE_WIDTH

    def set_live(self, live: Live) -> Any:
        shown = super().set_live(live)
        _on_screen.append(live)
        return shown

    def clear_live(self) -> None:
        super().clear_live()
        if _on_screen:
            _on_screen.pop()

    def print(self, *objects: Any, **options: Any) -> None:
        """As rich has it; above a spinner or progress bar that is shown on the same terminal.

        A sentence with `soft_wrap` is not broken.
        """
        if objects and all(isinstance(each, str | Text) for each in objects):
            if self.is_terminal and not options.get("soft_wrap"):
                sentence = Text(" ").join(_plain(each) for each in objects)
                sentence.plain = wrap_text(sentence.plain, self.width)
                objects = (sentence,)
            options = {"highlight": False, "soft_wrap": True} | options
        shown = _on_screen[-1].console if _on_screen else self
        if shown is not self and shown.is_terminal and self.is_terminal:
            shown.print(*objects, **options)
        else:
            super().print(*objects, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Text of a string: of a sentence, a title or a cell, before it is measured."""
        return super().render_str(printable_text(text), **options | {"markup": False, "emoji": False})

    def render(self, renderable: RenderableType, options: Any = None) -> Iterable[Segment]:
        """Segments of anything else, such as a `Text` or a table; rich's own control codes pass."""
        if isinstance(renderable, Table):
            renderable = fit_table(renderable, self, options or self.options)
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
        super().update(None if status is None else _plain(status), **options)


class PlainColumn(TextColumn):
    """A column of a progress bar whose text is no markup, and wraps where the terminal is narrow."""

    def __init__(self, text_format: str) -> None:
        """`text_format` as rich has it: `{task.description}`."""
        super().__init__(text_format, markup=False, table_column=Column(overflow="fold"))

    def render(self, task: Any) -> Text:
        return _plain(super().render(task).plain)


def results(json: Path | None = None) -> PlainConsole:
    """The console of a command's results: standard output, unless JSON is written there (`-`)."""
    return PlainConsole(stderr=str(json) == "-")


def command_line(*words: str, **options: object) -> str:
    """A command ready to be pasted; an option whose value is None is left out."""
    given = [(f"--{name.replace('_', '-')}", str(value)) for name, value in options.items() if value is not None]
    return shlex.join(["armlink", *words, *(word for pair in given for word in pair)])


def suggest(command: str) -> None:
    PlainConsole().print(f"next: {command}", style="bold", soft_wrap=True)


def confirm(question: str, *, abort: bool = True, default: bool = False) -> bool:
    """The answer to a yes-or-no question; raises Declined if the answer is no and `abort` is true."""
    with _question():
        agreed = typer.confirm(_wrapped_question(question), default=default, err=True)
    if abort and not agreed:
        raise Declined("the answer was no: nothing was done")
    return agreed


def ask(question: str, **options: Any) -> Any:
    """The answer to a question; `options` are those of `typer.prompt`."""
    with _question():
        return typer.prompt(_wrapped_question(question), err=True, **options)


def _wrapped_question(question: str) -> str:
    """With room for ` [y/N]: ` and the first letters of an answer behind it."""
    console, text = PlainConsole(), printable_text(question)
    return wrap_text(text, console.width - ANSWER_WIDTH) if console.is_terminal else text


@contextlib.contextmanager
def _question() -> Iterator[None]:
    """Spinners and progress bars stop while a person is asked, and nothing of the question goes to standard output."""
    stopped = list(reversed(_on_screen))
    for live in stopped:
        live.stop()
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        for live in reversed(stopped):
            live._live_render._shape = None  # else it erases as many lines above it as it had, such as the question
            live.start(refresh=True)


def _plain(text: RenderableType) -> Text:
    return Text(printable_text(text)) if isinstance(text, str) else cast(Text, text)
