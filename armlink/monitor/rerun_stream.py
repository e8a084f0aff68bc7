"""Live stream into a Rerun viewer: the joints' readings as one time series each."""

import contextlib
import socket
from importlib import import_module
from types import TracebackType
from typing import Any, Self

import numpy as np

from armlink.errors import BadInput
from armlink.extras import require_extra
from armlink.link.types import Sample

QUANTITIES = {"position": "rad", "velocity": "rad_per_s", "torque": "newton_metres", "motor_torque": "newton_metres"}
"""Reading → its unit, as a folder in the viewer."""
PATIENCE = 2.0
"""Time to find out whether a viewer is there [s]."""


class RerunStream:
    """Connection to a viewer on this machine; a context manager."""

    def __init__(self, name: str, names: tuple[str, ...], port: int) -> None:
        """Send joints with these names to the viewer at `port`. Raises BadInput without the package or a viewer."""
        require_extra("--rerun", "rerun")
        rerun: Any = import_module("rerun")
        try:
            socket.create_connection(("127.0.0.1", port), PATIENCE).close()
        except OSError as error:
            raise BadInput(f"--rerun {port}: no viewer there ({error}): start it with rerun --port {port}") from None
        self._scalars = rerun.Scalars
        self._stream = rerun.RecordingStream(f"armlink {name}")
        self._stream.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy")
        self._names = names

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        """Send what is left and disconnect."""
        with contextlib.suppress(Exception):
            self._stream.flush()
            self._stream.disconnect()

    def send(self, sample: Sample) -> None:
        """Readings of one sample at the present time, as QUANTITY/UNIT/JOINT; those that are missing are left out."""
        for quantity, unit in QUANTITIES.items():
            values = getattr(sample, quantity)
            for joint in np.flatnonzero(np.isfinite(values)).tolist():
                self._stream.log(f"{quantity}/{unit}/{self._names[joint]}", self._scalars(float(values[joint])))
