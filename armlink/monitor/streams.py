"""Live streams of the joints' readings into viewers: Foxglove (the topics of a recording) and Rerun."""

import contextlib
import socket
import time
from importlib import import_module
from typing import Any, Self

import numpy as np

from armlink.arrays import Array
from armlink.errors import BadInput
from armlink.extras import require_extra
from armlink.link.types import Sample
from armlink.recording.ros_joint_state import SCHEMA, SCHEMA_NAME, joint_state_encoder
from armlink.recording.wrench_bag import TOPICS, external_encoder

QUANTITIES = {"position": "rad", "velocity": "rad_per_s", "torque": "newton_metres", "motor_torque": "newton_metres"}
"""Reading → its unit, as a folder in the viewer."""
VIEWER_SECONDS = 2.0
"""Time to find out whether a viewer is there [s]."""


class FoxgloveServer:
    """Server that Foxglove connects to (ws://HOST:PORT); a context manager."""

    def __init__(self, name: str, topics: dict[str, tuple[str, str]], port: int, host: str = "127.0.0.1") -> None:
        """Serve topics, each with a schema's name and text; port 0 takes a free one.

        Raises BadInput without the package or the port.
        """
        require_extra("--foxglove", "foxglove")
        import foxglove

        self._context = context = foxglove.Context()  # channels close with it
        self._channels = {
            topic: foxglove.Channel(
                topic,
                schema=foxglove.Schema(name=schema, encoding="ros2msg", data=text.encode()),
                message_encoding="cdr",
                context=context,
            )
            for topic, (schema, text) in topics.items()
        }
        try:
            self._server: Any = foxglove.start_server(name=name, host=host, port=port, context=context)
        except Exception as error:  # the package's own, which it does not export
            raise BadInput(f"--foxglove {port}: cannot serve on {host}: {error}") from None
        self.port: int = self._server.port
        """Where it listens."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(Exception):
            self._server.stop()

    def log(self, topic: str, stamp: int, message: bytes) -> None:
        """Send a message of a time [ns]."""
        self._channels[topic].log(message, log_time=stamp)


class FoxgloveStream(FoxgloveServer):
    """Readings of an arm's joints."""

    def __init__(self, name: str, names: tuple[str, ...], port: int) -> None:
        """Joints with these names."""
        super().__init__(name, dict.fromkeys(("/joint_states", "/motor_states"), (SCHEMA_NAME, SCHEMA)), port)
        self._encode_states = joint_state_encoder(names, (True, True, True))
        self._encode_motors = joint_state_encoder(names, (False, False, True))

    def send(self, sample: Sample) -> None:
        """Readings of one sample at the present time: on /joint_states what joints read, on /motor_states the motors'.

        A topic without a reading is left out; a joint without one is NaN.
        """
        stamp = time.time_ns()
        if np.isfinite(sample.position).any():
            values = np.concatenate((sample.position, sample.velocity, sample.torque)).tolist()
            self.log("/joint_states", stamp, self._encode_states(stamp, values))
        if np.isfinite(sample.motor_torque).any():
            self.log("/motor_states", stamp, self._encode_motors(stamp, sample.motor_torque.tolist()))


class ExternalStream(FoxgloveServer):
    """External torque, its standard deviations and the wrench, on the topics of a bag that `external --out` writes."""

    def __init__(self, name: str, names: tuple[str, ...], frame_id: str, port: int) -> None:
        """Joints with these names, and the frame in whose axes the wrench is."""
        super().__init__(name, TOPICS, port)
        self._encode = external_encoder(names, frame_id)

    def send(self, torque: Array, std: Array, wrench: Array) -> None:
        """One row of now: (n,) [N·m] each, and force [N] and moment [N·m] (6,); NaN along axes not determined."""
        stamp = time.time_ns()
        for topic, message in self._encode(stamp, torque, std, wrench):
            self.log(topic, stamp, message)


class RerunStream:
    """Connection to a viewer on this machine; a context manager."""

    def __init__(self, name: str, names: tuple[str, ...], port: int) -> None:
        """Send joints with these names to the viewer at `port`. Raises BadInput without the package or a viewer."""
        require_extra("--rerun", "rerun")
        rerun: Any = import_module("rerun")
        try:
            socket.create_connection(("127.0.0.1", port), VIEWER_SECONDS).close()
        except OSError as error:
            raise BadInput(
                f"--rerun {port}: there is no viewer on this port ({error}): start a viewer with rerun --port {port}"
            ) from None
        self._scalars = rerun.Scalars
        self._stream = rerun.RecordingStream(f"armlink {name}")
        self._stream.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy")
        self._names = names

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(Exception):
            self._stream.flush()
            self._stream.disconnect()

    def send(self, sample: Sample) -> None:
        """Readings of one sample at the present time, as QUANTITY/UNIT/JOINT; those that are missing are left out."""
        for quantity, unit in QUANTITIES.items():
            values = getattr(sample, quantity)
            for joint in np.flatnonzero(np.isfinite(values)).tolist():
                self._stream.log(f"{quantity}/{unit}/{self._names[joint]}", self._scalars(float(values[joint])))
