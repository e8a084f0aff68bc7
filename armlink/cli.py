"""The console command: finds its sub-commands through entry points and imports one only when it is called."""

import ast
import importlib.util
import os
import re
import shutil
import sys
from importlib.metadata import EntryPoint, version
from pathlib import Path
from typing import Any, TextIO

from armlink import completion
from armlink.content.printable_text import PrintableFormatter, printable_text, wrap_text
from armlink.contributed import contributions
from armlink.termination import terminate_as_interrupt

PURPOSE = "Calibrates, watches and diagnoses robot arms, with and without torque sensors in their joints."
USAGE_STATUS = 2
INTERRUPTED_STATUS = 130
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment of the linear algebra, set before numpy is imported: our matrices are small, and threads that wait for
one another on a busy machine cost up to a hundred times the arithmetic."""


def main() -> None:
    """Run `armlink` on the command line's arguments and exit with the status of the contract (0, 1, 2, 3 or 130)."""
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")
    with terminate_as_interrupt():
        sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run one command line (without the program's name) and return its exit status."""
    points = {point.name: point for point in contributions("armlink.commands")}
    if not arguments or arguments[0] in ("--help", "-h"):
        sys.stdout.write(_help(points))
        return 0 if arguments else USAGE_STATUS
    name, rest = arguments[0], arguments[1:]
    if name == "--version":
        sys.stdout.write(f"armlink {version('armlink')}\n")
        return 0
    if name in (completion.WORD, "completion"):
        return _complete(points, name, rest)
    if name not in points:
        return _fail(_no_command(name, points), USAGE_STATUS)
    return _call(points[name], rest)


def _complete(points: dict[str, EntryPoint], name: str, words: list[str]) -> int:
    """Candidates for the shell, or the script that asks for them."""
    if name == completion.WORD:
        sys.stdout.writelines(f"{word}\n" for word in completion.candidates(points, words))
        return 0
    if words[:1] in (["--help"], ["-h"]):
        uses = "\n".join(f"  {use}" for use in completion.USE.values())
        shells = "|".join(completion.SCRIPTS)
        sys.stdout.write(
            f"Usage: armlink completion {shells}\n\n  Prints the script that completes commands and options.\n\n"
            f"{uses}\n\n  Example: armlink completion bash\n"
        )
        return 0
    if len(words) != 1 or words[0] not in completion.SCRIPTS:
        return _fail(f"completion: give a shell: {', '.join(completion.SCRIPTS)}", USAGE_STATUS)
    sys.stdout.write(completion.SCRIPTS[words[0]])
    return 0


def _no_command(name: str, points: dict[str, EntryPoint]) -> str:
    import difflib

    if name.lower().endswith((".urdf", ".xml", ".mjcf")):
        return f"there is no command {name!r}; to make an arm file from a model, use `armlink new {name}`"
    close = difflib.get_close_matches(name, [*points, "--help", "--version", "completion"], n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    return f"there is no command {name!r}; {hint}the commands are {', '.join(sorted(points))}"


def _call(point: EntryPoint, arguments: list[str]) -> int:
    try:
        return _invoke(point, arguments)
    except KeyboardInterrupt:
        return _fail("interrupted", INTERRUPTED_STATUS)
    except BrokenPipeError:  # whoever read our output has gone; Python's own flush at exit must not complain
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except ModuleNotFoundError as error:
        from armlink.extras import missing_extra

        said = missing_extra(point.name, error.name or "")
        if said is None:
            raise
        return _fail(said, USAGE_STATUS)
    except Exception as error:
        if hasattr(error, "format_message"):  # a usage error: unknown option, missing argument, bad value
            return _fail(f"{point.name}: {_usage(error)} (see armlink {point.name} --help)", USAGE_STATUS)
        if isinstance(error, OSError) and error.strerror is not None:  # a write to a full disk names no file
            return _fail(f"{error.filename or point.name}: {error.strerror}", USAGE_STATUS)
        status = getattr(error, "exit_status", None)  # every package's own error tree carries one
        if status is None:
            raise
        return _fail(str(error), int(status))


def _usage(error: Any) -> str:
    """Click's message, with what was probably meant."""
    message = str(error.format_message())
    begin, *suggested = re.split(r" ?\(?(?:Possible options:|Did you mean)", message)
    meant = re.findall(r"[\w-]+", " ".join(suggested))
    return f"{begin.rstrip('. ')}; did you mean {' or '.join(meant)}?" if meant else message


def _invoke(point: EntryPoint, arguments: list[str]) -> int:
    import logging

    import typer

    from armlink.commands.options import GroupedCommand

    if logging.lastResort is not None:
        logging.lastResort.setFormatter(PrintableFormatter(_columns(sys.stderr)))
    target = point.load()
    if isinstance(target, typer.Typer):
        app = target
        arguments = arguments or ["--help"]
    else:
        app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
        app.command(name=point.name, cls=GroupedCommand)(target)
    try:
        outcome = app(args=arguments, prog_name=f"armlink {point.name}", standalone_mode=False)
    except typer.Abort:
        raise KeyboardInterrupt from None
    if outcome == INTERRUPTED_STATUS:  # what newer typers make of Ctrl-C
        raise KeyboardInterrupt
    return outcome if isinstance(outcome, int) else 0


def _fail(message: str, status: int) -> int:
    line = f"armlink: {printable_text(' '.join(message.split()))}"
    sys.stderr.write(f"{_in_terminal(sys.stderr, line)}\n")
    return status


def _columns(stream: TextIO) -> int | None:
    """Columns of a terminal; None for a pipe or a file."""
    return shutil.get_terminal_size().columns if stream.isatty() else None


def _in_terminal(stream: TextIO, line: str, indent: int = 0) -> str:
    """The line as it is shown on `stream`: broken between words where that is a terminal, then with an indent."""
    columns = _columns(stream)
    return line if columns is None else wrap_text(line, columns - indent).replace("\n", "\n" + " " * indent)


def _help(points: dict[str, EntryPoint]) -> str:
    width = max(map(len, points), default=0)
    rows = "\n".join(
        f"  {name:<{width}}  {_in_terminal(sys.stdout, _summary(points[name]), width + 4)}" for name in sorted(points)
    )
    completed = "armlink completion bash|zsh|fish prints the script for completion in the shell."
    return (
        f"Usage: armlink COMMAND [OPTIONS]\n\n{_in_terminal(sys.stdout, PURPOSE)}\n\nCommands:\n{rows}\n\nOptions:\n"
        f"  --help     Shows this help; for a command: COMMAND --help.\n"
        f"  --version  Shows the version, {version('armlink')}.\n\n"
        f"{_in_terminal(sys.stdout, completed)}\n\nExample: armlink demo --seed 1\n"
    )


def _summary(point: EntryPoint) -> str:
    """First line of the docstring of a command's module, read without importing it."""
    spec = importlib.util.find_spec(point.module)
    if spec is None or spec.origin is None:
        return ""
    docstring = ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))) or ""
    return docstring.partition("\n")[0]


if __name__ == "__main__":
    main()
