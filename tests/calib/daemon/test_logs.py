"""The daemon's log: one JSON object a line on standard error."""

import json
import logging
from collections.abc import Iterator

import pytest

from calib.daemon.logs import log_as_json


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
    log_as_json()
    logging.getLogger("calib.test").info("hello %s", "you")
    logging.getLogger("calib.test").debug("not this")
    logging.getLogger("canopen.sdo").info("nor this")
    (line,) = capsys.readouterr().err.splitlines()
    assert "hello you" in json.loads(line).values()
    assert len(root.handlers) == 1
