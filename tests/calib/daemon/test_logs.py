"""The daemon's log: one JSON object a line on standard error."""

import io
import json
import logging
import sys
import threading
from collections.abc import Iterator

import pytest

from calib.daemon import logs
from calib.daemon.logs import log_to_stderr


@pytest.fixture
def root() -> Iterator[logging.Logger]:
    """The root logger, put back as it was."""
    logger = logging.getLogger()
    others = [logging.getLogger(name) for name in ("can", "canopen")]
    before = logger.handlers[:], logger.level, [other.level for other in others]
    yield logger
    logger.handlers[:] = before[0]
    logger.setLevel(before[1])
    for other, level in zip(others, before[2], strict=True):
        other.setLevel(level)


def test_what_is_logged_is_json_on_standard_error(root: logging.Logger, capsys: pytest.CaptureFixture[str]) -> None:
    log_to_stderr()
    logs.log_in_thread()
    logging.getLogger("calib.test").info("hello %s", "you")
    logging.getLogger("calib.test").debug("not this")
    logging.getLogger("canopen.sdo").info("nor this")
    (handler,) = root.handlers
    handler.stream.drain(60.0)  # type: ignore[attr-defined]
    (line,) = capsys.readouterr().err.splitlines()
    assert "hello you" in json.loads(line).values()


def test_a_terminal_gets_plain_lines(
    root: logging.Logger, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    log_to_stderr()
    logging.getLogger("calib.test").info("hello %s", "you\x1b[31m")
    logging.getLogger("calib.test").warning("too warm", extra={"joint": "elbow"})
    hello, warning = capsys.readouterr().err.splitlines()
    assert hello.endswith("  hello you\\x1b[31m")
    assert warning.endswith("  warning: too warm  joint=elbow")


class NobodyReads(io.StringIO):
    """As a pipe to a journal whose disk hangs."""

    def __init__(self) -> None:
        super().__init__()
        self.may = threading.Event()

    def write(self, text: str) -> int:
        self.may.wait(60)
        return super().write(text)


def test_a_reader_of_the_log_that_takes_nothing_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "MOST_LINES", 10)
    reader = NobodyReads()
    lines = logs.LineQueue(reader)
    for number in range(100):
        lines.write(f"{number}\n")
    assert reader.getvalue() == ""
    lines.drain(0.0)
    reader.may.set()
    lines.drain(60.0)
    written = reader.getvalue().split()
    assert written == [str(number) for number in range(len(written))]
    assert len(written) in (10, 11)
