"""Live stream into Foxglove: the topics of a recording (`armlink.recording.mcap`), served over a WebSocket."""

import contextlib
import time
from types import TracebackType
from typing import Any, Self

import numpy as np

from armlink.errors import BadInput
from armlink.extras import require_extra
from armlink.link.types import Sample
from armlink.recording.ros_joint_state import SCHEMA, SCHEMA_NAME, joint_state_encoder


class FoxgloveStream:
    """Server that Foxglove connects to (ws://HOST:PORT); a context manager."""

    def __init__(self, name: str, names: tuple[str, ...], port: int, host: str = "127.0.0.1") -> None:
        """Serve joints with these names; port 0 takes a free one. Raises BadInput without the package or the port."""
        require_extra("--foxglove", "foxglove")
        import foxglove

        self._context = context = foxglove.Context()  # channels close with it
        schema = foxglove.Schema(name=SCHEMA_NAME, encoding="ros2msg", data=SCHEMA.encode())
        self._states, self._motors = (
            foxglove.Channel(topic, schema=schema, message_encoding="cdr", context=context)
            for topic in ("/joint_states", "/motor_states")
        )
        self._encode_states = joint_state_encoder(names, (True, True, True))
        self._encode_motors = joint_state_encoder(names, (False, False, True))
        try:
            self._server: Any = foxglove.start_server(name=name, host=host, port=port, context=context)
        except Exception as error:  # the package's own, which it does not export
            raise BadInput(f"--foxglove {port}: cannot serve on {host}: {error}") from None
        self.port: int = self._server.port
        """Where it listens."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        with contextlib.suppress(Exception):
            self._server.stop()

    def send(self, sample: Sample) -> None:
        """Readings of one sample at the present time: on /joint_states what joints read, on /motor_states the motors'.

        A topic without a reading is left out; a joint without one is NaN.
        """
        stamp = time.time_ns()
        if np.isfinite(sample.position).any():
            values = np.concatenate((sample.position, sample.velocity, sample.torque)).tolist()
            self._states.log(self._encode_states(stamp, values), log_time=stamp)
        if np.isfinite(sample.motor_torque).any():
            self._motors.log(self._encode_motors(stamp, sample.motor_torque.tolist()), log_time=stamp)
