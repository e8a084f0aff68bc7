"""The readings of the last minutes: as JSON for the page, as CSV and MCAP to keep."""

import csv
import io
from collections.abc import Iterator
from datetime import timedelta
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query
from fastapi.responses import Response

from armlink.recording.joint_messages import TOPICS
from armlink.recording.mcap import RecordingWriter
from calib.daemon.view import DaemonView, Window, WindowRows
from calib.daemon.web.connection import Owner
from calib.daemon.web.history import Histories
from calib.daemon.web.parameters import WindowQuery
from gcomp.arrays import Array

COLUMNS = {"position": "q", "torque": "tau", "temperature": "temp", "model_torque": "model"}
"""Channel → prefix of its columns in CSV; q, tau and temp are those of a recording."""
MODEL_TOPICS = TOPICS | {"/model_torques": (None, None, "model_torque")}
"""In MCAP the model's torque is effort on a topic of its own."""
PIECE = 1 << 16
"""Bytes sent at once, so that a client that stops reading keeps little waiting."""
ROWS = 200
"""Rows of CSV in a piece."""
CSV, MCAP = "text/csv", "application/octet-stream"


def add_window(router: APIRouter, view: DaemonView, histories: Histories) -> None:
    """GET /api/window, /api/window.csv, /api/window.mcap."""

    @router.get("/api/window", response_model=WindowRows, tags=["past"])
    async def window(owner: Owner, query: Annotated[WindowQuery, Query()]) -> Response:
        """Readings of the last minutes, oldest first."""
        found = view.window(query.seconds, query.limit)
        return await histories.send(owner, iter([found]), _as_json, "application/json")

    @router.get("/api/window.csv", response_class=Response, responses=_file(CSV), tags=["past"])
    async def window_csv(owner: Owner, query: Annotated[WindowQuery, Query()]) -> Response:
        """The same as a recording in CSV, with the model's torques as further columns."""
        found = view.window(query.seconds, query.limit)
        return await histories.send(owner, csv_lines(found), str.encode, CSV, _attached(found, "csv"))

    @router.get("/api/window.mcap", response_class=Response, responses=_file(MCAP), tags=["past"])
    async def window_mcap(owner: Owner, query: Annotated[WindowQuery, Query()]) -> Response:
        """The same as a recording in MCAP, with the model's torques as effort on /model_torques."""
        found = view.window(query.seconds, query.limit)
        return await histories.send(owner, mcap_pieces(found), bytes, MCAP, _attached(found, "mcap"))


def csv_lines(window: Window) -> Iterator[str]:
    """A recording in CSV, many lines at a time; columns of a channel that is missing throughout are left out."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    channels = _present(window)
    numbers = range(1, len(window.names) + 1)
    writer.writerow(["t", *(f"{COLUMNS[name]}_{k}" for name in channels for k in numbers)])
    for first in range(0, len(window.t), ROWS):
        rows = slice(first, first + ROWS)
        for t, *values in zip(window.t[rows], *(each[rows] for each in channels.values()), strict=True):
            writer.writerow([f"{t:.6f}", *(f"{x:.7g}" for row in values for x in row)])
        yield text.getvalue()
        text.seek(0)
        text.truncate()
    if not len(window.t):
        yield text.getvalue()


def mcap_pieces(window: Window) -> Iterator[bytes]:
    """A recording in MCAP, its times those of the wall clock."""
    file, channels = io.BytesIO(), _present(window)
    oldest = window.time.timestamp() - float(window.t[-1]) if len(window.t) else 0.0
    with RecordingWriter(file, window.names, MODEL_TOPICS) as writer:
        for k, t in enumerate(window.t.tolist()):
            writer.append(oldest + t, {name: values[k] for name, values in channels.items()})
    content = file.getbuffer()
    for first in range(0, len(content), PIECE):
        yield bytes(content[first : first + PIECE])


def _present(window: Window) -> dict[str, Array]:
    """Position, torque, and what of the others is known at all."""
    always = ("position", "torque")
    return {
        name: window.channels[name] for name in COLUMNS if name in always or np.isfinite(window.channels[name]).any()
    }


def _as_json(window: Window) -> bytes:
    lists = {name: values.tolist() for name, values in window.channels.items()}
    own = {"time": window.time, "joints": window.names, "t": window.t.round(3).tolist()}
    return WindowRows.model_validate(own | lists).model_dump_json().encode()


def _file(kind: str) -> dict[int | str, dict[str, Any]]:
    return {200: {"content": {kind: {"schema": {"type": "string", "format": "binary"}}}, "description": "A recording"}}


def _attached(window: Window, suffix: str) -> dict[str, str]:
    begin = window.time - timedelta(seconds=float(window.t[-1]) if len(window.t) else 0.0)
    return {"content-disposition": f'attachment; filename="armlink-{begin:%Y%m%dT%H%M%S}Z.{suffix}"'}
