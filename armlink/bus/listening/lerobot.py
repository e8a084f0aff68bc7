"""Joint states of a LeRobot robot, from copies of what its own program reads and writes on the servos' line.

The program runs under `python -m armlink.lerobot` (or calls `share_lines`), which sends the copies. Here is a socket
that receives them, and no serial port.
"""

import contextlib
import math
import os
import socket
import time
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field

from armlink.bus.listening.joint_messages import JointStateMessage
from armlink.bus.listening.servo_lines import MODELS, RegisterAccess, ServoModel, accesses
from armlink.errors import BadInput, BusFault
from armlink.lerobot import HEADER, MARK, PIECE, SUFFIX, listeners_folder

SO_ARM = {
    "shoulder_pan": (1, "sts3215"), "shoulder_lift": (2, "sts3215"), "elbow_flex": (3, "sts3215"),
    "wrist_flex": (4, "sts3215"), "wrist_roll": (5, "sts3215"), "gripper": (6, "sts3215"),
}  # fmt: skip
KOCH = {
    "shoulder_pan": (1, "xl430-w250"), "shoulder_lift": (2, "xl430-w250"), "elbow_flex": (3, "xl330-m288"),
    "wrist_flex": (4, "xl330-m288"), "wrist_roll": (5, "xl330-m288"), "gripper": (6, "xl330-m288"),
}  # fmt: skip
OMX = {
    "shoulder_pan": (11, "xl430-w250"), "shoulder_lift": (12, "xl430-w250"), "elbow_flex": (13, "xl430-w250"),
    "wrist_flex": (14, "xl330-m288"), "wrist_roll": (15, "xl330-m288"), "gripper": (16, "xl330-m288"),
}  # fmt: skip
ROBOTS: dict[str, Mapping[str, tuple[int, str]]] = {
    "so100_follower": SO_ARM,
    "so101_follower": SO_ARM,
    "koch_follower": KOCH,
    "omx_follower": OMX,
    "lekiwi": {f"arm_{name}": servo for name, servo in SO_ARM.items()},
}
"""Robot type of LeRobot (0.4) → motor → id on the line and model."""
LARGEST_DATAGRAM = 65_536


@dataclass
class LoopRow:
    """Values of one pass of the program's loop, by motor."""

    time: float
    """Of its first request [s]."""
    position: dict[str, float] = field(default_factory=dict)
    velocity: dict[str, float] = field(default_factory=dict)
    current: dict[str, float] = field(default_factory=dict)
    target: dict[str, float] = field(default_factory=dict)
    """Written before its readings."""


class LoopRows:
    """Rows of readings from the requests of one program. A row ends where a position is read anew."""

    def __init__(self, motors: Mapping[str, tuple[int, str]]) -> None:
        self._motors = {servo: (name, MODELS[model]) for name, (servo, model) in motors.items()}
        self._row: LoopRow | None = None
        self._targets: dict[str, float] = {}
        self._currents: list[tuple[float, str, float]] = []
        """Read since the row's positions: time, motor and current."""

    def take(self, time: float, request: bytes, answer: bytes) -> LoopRow | None:
        """Take in a request with its answers; the row that it ends, if any."""
        read, written = accesses(request, answer)
        ended = None
        values = [(found, each) for each in read if (found := self._motors.get(each.id)) is not None]
        positions = {
            name: value for (name, model), each in values if math.isfinite(value := model.position.value(each))
        }
        if positions and (self._row is None or positions.keys() & self._row.position.keys()):
            ended = self._next_row(time)
        for (name, model), each in values:
            self._keep(time, name, model, each)
        for each in written:
            known = self._motors.get(each.id)
            if known is not None and math.isfinite(target := known[1].target.value(each)):
                self._targets[known[0]] = target
        return ended

    def _keep(self, time: float, name: str, model: ServoModel, access: RegisterAccess) -> None:
        position, velocity = model.position.value(access), model.velocity.value(access)
        if self._row is not None and math.isfinite(position):
            self._row.position[name] = position
        if self._row is not None and math.isfinite(velocity):
            self._row.velocity[name] = velocity
        current = math.nan if model.current is None else model.current.value(access)
        if math.isfinite(current):
            self._currents.append((time, name, current))

    def _next_row(self, time: float) -> LoopRow | None:
        """Begin a row; a current belongs to the positions that were read nearest to it."""
        ended, self._row = self._row, LoopRow(time, target=self._targets)
        self._targets = {}
        for at, name, current in self._currents:
            near = self._row if ended is None or at - ended.time > time - at else ended
            near.current.setdefault(name, current)
        self._currents = []
        return ended


class RobotLine:
    """Messages of the program that runs a robot on a serial port of this machine."""

    def __init__(self, kind: str, port: str, motors: Mapping[str, tuple[int, str]]) -> None:
        """Raises BusFault where the socket cannot be made."""
        self._kind, self._port, self._motors = kind, port, motors
        folder = listeners_folder(port)
        self._path = folder / f"{os.getpid()}-{id(self):x}{SUFFIX}"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            if folder.parent.stat().st_uid != os.getuid():
                raise PermissionError(0, "it belongs to another user")
            folder.parent.chmod(0o700)
            self._socket.bind(str(self._path))
        except OSError as error:
            self._socket.close()
            raise BusFault(f"bus lerobot:{kind}:{port}: cannot listen in {folder}: {error}") from None
        self._rows: dict[Hashable, LoopRows] = {}
        self._numbers: dict[Hashable, int] = {}
        self.lost = 0

    def take(self) -> list[JointStateMessage]:
        found: list[JointStateMessage] = []
        while True:
            try:
                content = self._socket.recv(LARGEST_DATAGRAM)
            except BlockingIOError:
                return found
            except OSError as error:
                raise BusFault(f"bus lerobot:{self._kind}:{self._port}: cannot listen: {error.strerror}") from None
            message = self._message(content)
            if message is not None:
                found.append(message)

    def _message(self, content: bytes) -> JointStateMessage | None:
        if len(content) < HEADER.size:
            return None
        mark, process, number = HEADER.unpack_from(content)
        if mark != MARK:
            return None
        before = self._numbers.get(process, number - 1)
        self.lost += max(number - before - 1, 0)
        self._numbers[process] = number
        time_of, request, answer = _exchange(content[HEADER.size :])
        rows = self._rows.setdefault(process, LoopRows(self._motors))
        row = rows.take(time_of, request, answer) if request else None
        return None if row is None else _message_of(process, row)

    def absence(self) -> str:
        return (
            f"start the program of the robot with `python -m armlink.lerobot COMMAND …`, as the same user and on "
            f"port {self._port} (docs/listening.md)"
        )

    def close(self) -> None:
        self._socket.close()
        with contextlib.suppress(OSError):
            self._path.unlink()


def _exchange(content: bytes) -> tuple[float, bytes, bytes]:
    """Time of a request [s], its bytes, and those of its answers."""
    time_of, request, answer = math.nan, b"", b""
    start = 0
    while start + PIECE.size <= len(content):
        now, written, size = PIECE.unpack_from(content, start)
        start += PIECE.size
        if written:
            time_of, request = now, request + content[start : start + size]
        else:
            answer += content[start : start + size]
        start += size
    return time_of, request, answer


def _message_of(process: Hashable, row: LoopRow) -> JointStateMessage:
    names = list(row.position)

    def column(values: dict[str, float]) -> list[float]:
        return [values.get(name, math.nan) for name in names] if values else []

    columns = [column(each) for each in (row.position, row.velocity, row.current, row.target)]
    return JointStateMessage(process, time.monotonic(), row.time, names, *columns)


def open_robot(channel: str) -> tuple[RobotLine, dict[str, float]]:
    """The robot TYPE:PORT, and the torque constants of its motors that tell their current [N·m/A].

    Raises BadInput, BusFault.
    """
    kind, colon, port = channel.partition(":")
    if not (colon and port) or kind not in ROBOTS:
        raise BadInput(
            f"lerobot {channel!r}: expected TYPE:PORT, for example so101_follower:/dev/ttyACM0; the types are "
            f"{', '.join(ROBOTS)}"
        )
    motors = ROBOTS[kind]
    constants = {name: MODELS[model].torque_constant for name, (_, model) in motors.items()}
    return RobotLine(kind, port, motors), {name: each for name, each in constants.items() if math.isfinite(each)}
