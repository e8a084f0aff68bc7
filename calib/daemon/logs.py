"""Logs on stderr: one JSON object per line for systemd's journal or any log collector, plain lines on a terminal."""

import atexit
import logging
import queue
import sys
import threading
from collections import Counter
from datetime import UTC, datetime
from typing import TextIO

from armlink.content.printable_text import printable_json, printable_text
from calib.daemon.environment import CLOSING_SECONDS
from calib.daemon.rate_limit import Rate, RateLimit

MOST_LINES = 10_000
"""Lines that wait for a reader of stderr that takes none; further ones are dropped."""
LINES = Rate(burst=200, per_second=20)
"""Of one logger."""
_KNOWN = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


class JsonFormatter(logging.Formatter):
    """time, level, logger, message, the fields given as `extra`, and the exception if there is one."""

    def format(self, record: logging.LogRecord) -> str:
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= {name: value for name, value in vars(record).items() if name not in _KNOWN and value is not None}
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return printable_json(line, default=str)


class PlainFormatter(logging.Formatter):
    """Time of day, level unless it is info, message, and the fields given as `extra`."""

    def format(self, record: logging.LogRecord) -> str:
        """One line for people, or more with an exception."""
        at = datetime.fromtimestamp(record.created).strftime("%H:%M:%S")
        level = "" if record.levelno == logging.INFO else f"{record.levelname.lower()}: "
        given = {name: value for name, value in vars(record).items() if name not in _KNOWN and value is not None}
        fields = "".join(f"  {name}={value}" for name, value in given.items())
        line = f"{at}  {level}{printable_text(record.getMessage() + fields)}"
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line


class LineQueue:
    """A text stream before another, which a thread writes: systemd's journal waits for a disk, nobody here for it."""

    def __init__(self, to: TextIO) -> None:
        self._to = to
        self._lines = queue.Queue[str](MOST_LINES)
        threading.Thread(target=self._run, name="log", daemon=True).start()
        atexit.register(self.drain, CLOSING_SECONDS)

    def write(self, text: str) -> None:
        try:
            self._lines.put_nowait(text)
        except queue.Full:
            return

    def flush(self) -> None:
        """The thread does."""

    def drain(self, seconds: float) -> None:
        """Wait until everything is written, at most so long [s]."""
        with self._lines.all_tasks_done:
            self._lines.all_tasks_done.wait_for(lambda: not self._lines.unfinished_tasks, seconds)

    def _run(self) -> None:
        while True:
            text = self._lines.get()
            try:
                self._to.write(text)
                self._to.flush()
            except (OSError, ValueError):  # nobody reads, or it is closed
                pass
            self._lines.task_done()


class LineLimit(logging.Filter):
    """Limits the lines of each logger; the next line says how many were left out."""

    def __init__(self, rate: Rate = LINES) -> None:
        super().__init__()
        self._limit, self._missing = RateLimit(rate), Counter[str]()

    def filter(self, record: logging.LogRecord) -> bool:
        if self._limit.take(record.name, record.created):
            self._missing[record.name] += 1
            return False
        if missing := self._missing.pop(record.name, 0):
            record.left_out = missing
        return True


def log_to_stderr() -> None:
    """Send everything that is logged to stderr: as JSON, or in plain lines to a terminal."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(PlainFormatter() if sys.stderr.isatty() else JsonFormatter())
    handler.addFilter(LineLimit())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
    for chatty in ("can", "canopen"):  # they log every socket that they open, and every SDO
        logging.getLogger(chatty).setLevel(logging.WARNING)


def log_in_thread() -> None:
    """From now on a thread writes what is logged; not before a fork, which takes no threads along."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, logging.StreamHandler) and isinstance(handler.formatter, JsonFormatter | PlainFormatter):
            handler.setStream(LineQueue(handler.stream))
