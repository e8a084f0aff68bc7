"""Structured logs: one JSON object per line on stderr, for systemd's journal or any log collector."""

import logging
import sys
from datetime import UTC, datetime

from armlink.content.printable_text import printable_json

_KNOWN = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


class JsonFormatter(logging.Formatter):
    """time, level, logger, message, the fields given as `extra`, and the exception if there is one."""

    def format(self, record: logging.LogRecord) -> str:
        """One line of JSON."""
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


class LineLimit(logging.Filter):
    """Lets a logger have so many lines at once and so many a second; the next line says how many were left out."""

    def __init__(self, burst: float = 200.0, per_second: float = 20.0) -> None:
        super().__init__()
        self._burst, self._per_second = burst, per_second
        self._buckets: dict[str, tuple[float, float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a line is written."""
        left, since, missing = self._buckets.get(record.name, (self._burst, record.created, 0))
        left = min(self._burst, left + max(record.created - since, 0.0) * self._per_second)
        if left < 1.0:
            self._buckets[record.name] = left, record.created, missing + 1
            return False
        self._buckets[record.name] = left - 1.0, record.created, 0
        if missing:
            record.left_out = missing
        return True


def log_as_json(level: int = logging.INFO) -> None:
    """Send everything that is logged to stderr as JSON."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    handler.addFilter(LineLimit())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level)
    for chatty in ("can", "canopen"):  # they log every socket that they open, and every SDO
        logging.getLogger(chatty).setLevel(max(level, logging.WARNING))
