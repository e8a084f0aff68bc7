#!/usr/bin/env python3
"""Guards the CAN interface of an arm: from a program's side to the wire it passes only what a policy allows.

    python3 -I bus_guard.py POLICY PROGRAM_INTERFACE WIRE_INTERFACE

The guard alone has the wire; whatever commands the arm has an interface of its own, such as a vcan. All that comes from
the wire goes to the program. From the program to the wire go only identifiers that the policy names, with every field
within its bounds. The first frame that is not allowed closes the guard: it sends the policy's stop frames, says what it
was in one line, and passes nothing more until it is started again; the drives' own watches then see a silent host.
So do a frame on the wire that only the program may send, since then another host is there, and frames that were lost.
A frame that has waited here for longer than the drives wait for their host goes nowhere.

One file on the standard library, so that no fault elsewhere can change what it does. The policy is written by
`armlink guard`; `Policy` below says what it holds. Values in it are those of the bytes: whole numbers in drive units.
"""

import contextlib
import errno
import json
import math
import select
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable, Collection, Iterable
from typing import Any

SCHEMA = "armlink.guard/1"
FRAME, FD_FRAME = struct.Struct("=IBB2x8s"), struct.Struct("=IBB2x64s")
EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29
FD_FLAGS = 0x05
"""CAN FD with bit-rate switch."""
FULL = 0.05
"""A frame waits this long for a full transmit queue [s]."""
BATCH = 64
"""Frames taken from one side before the other is looked at."""
RECEIVE_BUFFER = 1 << 21
"""Size of a receive queue [bytes], some thousand frames; what its user may not have, the kernel cuts off."""
SO_RCVBUFFORCE, SO_TIMESTAMPNS, SO_RXQ_OVFL = 33, 35, 40
"""Of Linux (asm-generic/socket.h): a buffer beyond rmem_max, time of reception, count of lost frames."""
STAMP, COUNT = struct.Struct("@ll"), struct.Struct("=I")
CONTROL = socket.CMSG_SPACE(STAMP.size) + socket.CMSG_SPACE(COUNT.size)
NUMBERS = "bBhHiIqQf"
"""Codes of `struct` that a field may have."""


class PolicyError(Exception):
    """A policy that cannot be used."""


class Source:
    """Where a reading stands: frame id, bytes that it begins with, place and code of the number."""

    def __init__(self, found: dict[str, Any]) -> None:
        self.id, self.prefix = int(found["frame"]), bytes.fromhex(found.get("prefix", ""))
        self.at, self.number = int(found["at"]), _number(found)

    def value(self, data: bytes) -> float | None:
        if not data.startswith(self.prefix) or len(data) < self.at + self.number.size:
            return None
        number: float = self.number.unpack_from(data, self.at)[0]
        return number


class Field:
    """One number of a frame and its bounds.

    `values`: the only ones allowed. `least`, `most`: its range. `rate`, `slack`: it changes by at most `rate` a second,
    after a pause by `slack`; but a number within `within` of one of the two newest readings (`near`), no older than
    `age` seconds, commands what is, and may come at once. Without power it is not followed: then its range alone
    counts, and the first number with power must be near a reading or one of `first`.

    `leads_back`: a joint may stand outside the range. It may be told to stay there, and then only to go inwards.
    """

    def __init__(self, found: dict[str, Any]) -> None:
        """From the policy; raises PolicyError for a field without bounds."""
        self.name, self.at, self.number = str(found["name"]), int(found["at"]), _number(found)
        self.values = None if found.get("values") is None else frozenset(found["values"])
        self.least, self.most = _bound(found, "least", -math.inf), _bound(found, "most", math.inf)
        self.rate, self.slack = _bound(found, "rate", math.inf), _bound(found, "slack", 0.0)
        self.near, self.within = [Source(each) for each in found.get("near", ())], _bound(found, "within", 0.0)
        self.age, self.first = _bound(found, "age", 0.0), frozenset(found.get("first", ()))
        self.leads_back = bool(found.get("leads_back", False))
        if self.values is None and not (math.isfinite(self.least) and math.isfinite(self.most)):
            raise PolicyError(f"{self.name}: the field needs `values`, or `least` and `most`")
        self._last: float | None = None
        self._readings: list[tuple[float, float]] = []
        self._room, self._at = self.slack, -math.inf

    def see(self, value: float, now: float) -> None:
        self._readings = [*self._readings[-1:], (value, now)]

    def refusal(self, data: bytes, now: float, power: bool = True) -> str:
        """Why this frame's number is not allowed, or an empty text. Keeps nothing: see `keep`."""
        value = self.number.unpack_from(data, self.at)[0]
        if self.values is not None:
            if value in self.values:
                return ""
            return f"{self.name} is {value}, which is not among the {len(self.values)} allowed values"
        known = [reading for reading, at in self._readings if now - at <= self.age]
        near = any(abs(value - reading) <= self.within for reading in known)
        began = [self._last] if power and self._last is not None else known
        if not (self.least <= value <= self.most or (self.leads_back and self._inwards(value, began))):
            return f"{self.name} is {value}, allowed are {self.least:g} to {self.most:g}"
        if not power or self.rate == math.inf or near:
            return ""
        if self._last is None:
            if value in self.first:
                return ""
            return f"{self.name} is {value} in a frame that gives power, but no reading of the joint is near this value"
        if abs(value - self._last) <= self._room_at(now):
            return ""
        return f"{self.name} changes from {self._last} to {value} in one frame, limit {self._room_at(now):g}"

    def _inwards(self, value: float, began: list[float]) -> bool:
        """Whether a number outside the range is no further out than one of these, where the joint stands or was led."""
        return any(self.most < value <= each or self.least > value >= each for each in began)

    def keep(self, data: bytes, now: float, power: bool = True) -> None:
        """The frame passes: later ones start from its number."""
        if not power:
            self._last = None
            return
        value = self.number.unpack_from(data, self.at)[0]
        if self.rate != math.inf:
            spent = 0.0 if self._last is None else abs(value - self._last)
            self._room, self._at = max(0.0, self._room_at(now) - spent), now
        self._last = value

    def _room_at(self, now: float) -> float:
        return min(self.slack, self._room + self.rate * max(0.0, now - self._at))


class Allowance:
    """How often a frame may come: `per_second`, by default any number, and after a pause `burst` of them at once."""

    def __init__(self, found: dict[str, Any]) -> None:
        self._rate, self._burst = _bound(found, "per_second", math.inf), _bound(found, "burst", 1.0)
        self._room, self._at = self._burst, -math.inf

    def refusal(self, now: float) -> str:
        """Why one more is too many, or an empty text; one more is then counted."""
        if self._rate == math.inf:
            return ""
        self._room = min(self._burst, self._room + self._rate * max(0.0, now - self._at))
        self._at = max(now, self._at)
        if self._room < 1.0:
            return f"is sent more often than {self._rate:g} times a second"
        self._room -= 1.0
        return ""


class Frame:
    """Frames with one identifier: lengths, fields, how often, and what a drive must have acknowledged before.

    `power`: the number whose bits of `mask` are `value` in a frame that gives the drive power; without it all do.
    """

    def __init__(self, found: dict[str, Any]) -> None:
        """From the policy; raises PolicyError for a field beyond the frame's bytes."""
        self.lengths = frozenset(found["lengths"])
        self.fields = [Field(each) for each in found.get("fields", ())]
        self.allowance = Allowance({"name": "frame", **found})
        self.after = frozenset((int(can_id), bytes.fromhex(data)) for can_id, data in found.get("after", ()))
        power = found.get("power")
        self._power = (
            None if power is None else (Source({"frame": 0, **power}), int(power["mask"]), int(power["value"]))
        )
        shortest = min(self.lengths)
        for field in self.fields:
            if field.at < 0 or field.at + field.number.size > shortest:
                raise PolicyError(f"{field.name}: the field ends beyond the {shortest} bytes of its frame")

    def powers(self, data: bytes) -> bool:
        """Whether the drive follows the numbers of a frame."""
        if self._power is None:
            return True
        source, mask, value = self._power
        return int(source.value(data) or 0) & mask == value

    def pick(self, data: bytes) -> Iterable[Field] | None:
        """The fields that a frame with these bytes has, None if it is not allowed at all."""
        return self.fields if len(data) in self.lengths else None

    def commands(self, data: bytes) -> bool:
        """Whether a frame makes a drive do anything; else it only asks."""
        return True

    def all_fields(self) -> Collection[Field]:
        return self.fields


class Requests:
    """SDO requests to one node: reads, and expedited writes of the objects named."""

    UPLOAD, SEGMENTS, ABORT, DOWNLOAD = 0x40, (0x60, 0x70), 0x80, 0x23

    def __init__(self, found: dict[str, Any]) -> None:
        self.after: frozenset[tuple[int, bytes]] = frozenset()
        self.allowance = Allowance({"name": "request"})
        self.writes: dict[bytes, Field] = {}
        for place, each in found["sdo"].items():
            index, sub = (int(part, 16) for part in place.split(":"))
            self.writes[struct.pack("<HB", index, sub)] = Field({"at": 4, **each})

    def powers(self, data: bytes) -> bool:
        """A write counts at once."""
        return True

    def pick(self, data: bytes) -> Iterable[Field] | None:
        if len(data) != 8:
            return None
        command = data[0]
        if not self.commands(data):
            return ()
        field = self.writes.get(data[1:4])
        if field is None or command != self.DOWNLOAD | (4 - field.number.size) << 2 or field.number.size > 4:
            return None
        return (field,)

    def commands(self, data: bytes) -> bool:
        """As Frame.commands: reads and aborts do not."""
        return data[:1] not in (bytes([each]) for each in (self.UPLOAD, self.ABORT, *self.SEGMENTS))

    def all_fields(self) -> Collection[Field]:
        return self.writes.values()


class Policy:
    """Frames that may pass: `frames` by identifier (with the flag of 29 bits in bit 31), `stop` frames, `restarts`.

    A frame in `restarts` means that a drive has forgotten its set-up: what it acknowledged counts no more. The drives
    wait for `deadline` seconds for their host. `fd`: whether frames are CAN FD; without it both may pass.
    """

    def __init__(self, content: Any) -> None:
        """From the file's content; raises PolicyError."""
        try:
            if content["schema"] != SCHEMA:
                raise PolicyError(f"`schema` is {content['schema']!r}, expected {SCHEMA}")
            self.frames: dict[int, Frame | Requests] = {
                int(key): Requests(each) if "sdo" in each else Frame(each) for key, each in content["frames"].items()
            }
            self.stop = [(int(can_id), bytes.fromhex(data)) for can_id, data in content["stop"]]
            self.restarts = {int(key): int(answers) for key, answers in content.get("restarts", {}).items()}
            self.deadline = _bound({"name": "policy", **content}, "deadline", math.inf)
            self.fd = None if content.get("fd") is None else bool(content["fd"])
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError, struct.error) as error:
            raise PolicyError(f"{type(error).__name__}: {error}") from None
        self._sources: dict[int, list[tuple[Source, Field]]] = {}
        for frame in self.frames.values():
            for field in frame.all_fields():
                for source in field.near:
                    self._sources.setdefault(source.id, []).append((source, field))
        self._awaited: dict[int, set[bytes]] = {}
        for frame in self.frames.values():
            for can_id, data in frame.after:
                self._awaited.setdefault(can_id, set()).add(data)
        self._acknowledged: set[tuple[int, bytes]] = set()
        self._drives = frozenset(self._sources) | frozenset(self._awaited) | frozenset(self.restarts)

    def hear(self, can_id: int, data: bytes, now: float) -> None:
        for source, field in self._sources.get(can_id, ()):
            value = source.value(data)
            if value is not None:
                field.see(value, now)
        for prefix in self._awaited.get(can_id, ()):
            if data.startswith(prefix):
                self._acknowledged.add((can_id, prefix))
        if can_id in self.restarts and data[:1] == b"\0":
            answers = self.restarts[can_id]
            self._acknowledged = {each for each in self._acknowledged if each[0] != answers}

    def refusal(self, can_id: int, data: bytes, now: float) -> str:
        """Why a frame of the program may not pass, or an empty text; what passes is kept as where the next starts."""
        frame = self.frames.get(can_id)
        if frame is None and can_id in self._drives:
            return (
                f"the program sent identifier {can_id:X}h, which only a drive may send: stop a second guard, or "
                "a program that plays a drive"
            )
        if frame is None:
            return f"the program sent identifier {can_id:X}h, which the policy does not name"
        fields = frame.pick(data)
        if fields is None:
            return (
                f"the program sent {can_id:X}h with {data.hex(' ') or 'no data'}, which is no request that the "
                "policy allows"
            )
        if not frame.after <= self._acknowledged:
            return (
                f"the program sent {can_id:X}h, but the drive has not acknowledged the settings of this frame "
                "since the drive or the guard started: set up the arm again"
            )
        power = frame.powers(data)
        for field in fields:
            why = field.refusal(data, now, power)
            if why:
                return f"{can_id:X}h: {why}"
        why = frame.allowance.refusal(now)
        if why:
            return f"{can_id:X}h: {why}"
        for field in fields:
            field.keep(data, now, power)
        return ""


class GuardPort:
    """One raw CAN socket."""

    patience = FULL
    """A frame waits this long for a full transmit queue [s]."""
    lost = 0
    """Frames that the receive queue had no room for."""

    def __init__(self, interface: str) -> None:
        """Raises OSError."""
        self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.fd = True
        try:
            self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        except OSError:
            self.fd = False
        try:
            self.socket.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER)
        except OSError:  # without CAP_NET_ADMIN
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        for option in (SO_TIMESTAMPNS, SO_RXQ_OVFL):
            self.socket.setsockopt(socket.SOL_SOCKET, option, 1)
        self.socket.bind((interface,))
        self.socket.setblocking(False)

    def receive(self) -> tuple[int, bytes, bool, float] | None:
        """(identifier with flags, data, whether CAN FD, when it came by time.monotonic()), None if nothing is there."""
        try:
            raw, controls, _, _ = self.socket.recvmsg(FD_FRAME.size, CONTROL)
        except BlockingIOError:
            return None
        now = came = time.monotonic()
        for level, kind, value in controls:
            if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS:
                seconds, nano = STAMP.unpack(value)
                came = now - max(0.0, time.time() - seconds - 1e-9 * nano)
            elif level == socket.SOL_SOCKET and kind == SO_RXQ_OVFL:
                self.lost = COUNT.unpack(value)[0]
        layout = FRAME if len(raw) == FRAME.size else FD_FRAME
        can_id, length, _, data = layout.unpack(raw)
        return can_id, data[:length], layout is FD_FRAME, came

    def send(self, can_id: int, data: bytes, fd: bool = False) -> bool:
        """Send; whether it left before a full queue made it wait too long."""
        layout, flags = (FD_FRAME, FD_FLAGS) if fd else (FRAME, 0)
        raw, end = layout.pack(can_id, len(data), flags, data), time.monotonic() + self.patience
        while True:
            try:
                self.socket.send(raw)
            except OSError as error:
                if error.errno not in (errno.ENOBUFS, errno.EAGAIN) or time.monotonic() > end:
                    return False
                time.sleep(5e-4)
            else:
                return True


class BusGuard:
    """Passes frames between the two sides until it is closed."""

    def __init__(
        self, policy: Policy, program: GuardPort, wire: GuardPort, say: Callable[[str], object] | None = None
    ) -> None:
        """`say` gets one line when the guard closes."""
        self.policy, self.program, self.wire, self._say = policy, program, wire, say or _say
        self.closed = ""
        """Why nothing more passes to the wire; empty while it is open."""
        self._late = False
        """Whether the newest frame of the program had waited too long."""

    def step(self, seconds: float) -> None:
        """Wait at most this long for frames of either side and pass them."""
        ready, _, _ = select.select([self.wire.socket, self.program.socket], [], [], seconds)
        for side in ready:
            pass_on = self._to_program if side is self.wire.socket else self._to_wire
            port = self.wire if side is self.wire.socket else self.program
            for _ in range(BATCH):
                frame = port.receive()
                if frame is None:
                    break
                self._check_losses()
                pass_on(*frame)

    def _to_program(self, can_id: int, data: bytes, fd: bool, came: float | None = None) -> None:
        if can_id & (ERROR | REMOTE):
            return
        frame = self.policy.frames.get(can_id)
        if frame is None:
            self.policy.hear(can_id, data, time.monotonic() if came is None else came)
            self.program.send(can_id, data, fd)
        elif not self.closed and frame.commands(data):  # a closed guard passes none on: two would do so for ever
            self.program.send(can_id, data, fd)
            self.close(
                f"{can_id:X}h came on the wire and is not from this guard: another host commands the drives there"
            )

    def _to_wire(self, can_id: int, data: bytes, fd: bool, came: float | None = None) -> None:
        if self.closed:
            return
        now = time.monotonic()
        came = now if came is None else came
        if now - came > self.policy.deadline:
            self._tell_late(now - came)
            return
        self._late = False
        why = ""
        if can_id & (ERROR | REMOTE):
            why = f"the program sent {can_id & 0x1FFFFFFF:X}h as a remote or error frame, which no policy allows"
        if not why and self.policy.fd not in (None, fd):
            why = (
                f"the program sent {can_id:X}h as {'CAN FD' if fd else 'classical CAN'}, but by the policy (`fd`) this "
                f"bus carries only {'classical CAN' if fd else 'CAN FD'}"
            )
        why = why or self.policy.refusal(can_id, data, came)
        if why:
            self.close(why)
        elif not self.wire.send(can_id, data, fd):
            self.close(
                "the wire takes no frames: is the interface up, does any node acknowledge, do other nodes fill the bus?"
            )

    def _check_losses(self) -> None:
        """A lost frame may have been a drive's restart, or a stop."""
        for port, name in ((self.wire, "wire"), (self.program, "program")):
            if port.lost and not self.closed:
                self.close(
                    f"{port.lost} frames from the {name} were lost: too many frames were sent, or this guard gets "
                    "too little CPU time"
                )

    def _tell_late(self, age: float) -> None:
        """The drives have stopped by themselves meanwhile; what the program said before counts no more."""
        if not self._late:
            self._say(f"guard: frames that are {age:.3f} s old are dropped, limit {self.policy.deadline:g} s")
        self._late = True

    def close(self, why: str) -> None:
        """Stop the joints and pass nothing more."""
        self.closed = why
        told = [self.wire.send(can_id, data) for can_id, data in self.policy.stop]
        then = "the joints were commanded to stop"
        if not all(told):
            then = "the stop commands could not be sent: the joints stop when their drives miss the host"
        self._say(f"guard: closed, so it passes no more frames: {why}; {then}; start the guard again to open it")


def _number(found: dict[str, Any]) -> struct.Struct:
    code = found["code"]
    if len(code) != 1 or code not in NUMBERS:
        raise PolicyError(f"{found.get('name', 'reading')}: number code {code!r}, expected one of {', '.join(NUMBERS)}")
    return struct.Struct("<" + code)


def _bound(found: dict[str, Any], key: str, default: float) -> float:
    value = float(found.get(key, default))
    if math.isnan(value):
        raise PolicyError(f"{found['name']}: `{key}` is not a number")
    return value


def _say(text: str) -> None:
    """One line; names come from the policy and the system, and nothing in them acts on a terminal."""
    shown = (each if each.isprintable() else each.encode("unicode_escape").decode("ascii") for each in text)
    with contextlib.suppress(OSError, ValueError):  # nobody may be there to read it
        sys.stderr.write("".join(shown) + "\n")
        sys.stderr.flush()


def main(words: list[str]) -> int:
    """Run until a signal to end, which closes the guard; exit status 2 for a wrong policy or interface."""
    if len(words) != 3:
        _say(__doc__.splitlines()[2].strip())
        return 2
    path, program, wire = words
    if program == wire:
        _say(
            f"guard: {wire} is given as both interfaces: give first an interface for programs alone (such as a "
            "vcan), then the interface of the arm"
        )
        return 2
    try:
        with open(path, encoding="utf-8") as file:
            policy = Policy(json.load(file))
    except (OSError, ValueError, RecursionError, PolicyError) as error:
        _say(f"guard: {path}: {error}; `armlink guard --help` describes how to write this file")
        return 2
    ports = []
    for name in (program, wire):
        try:
            ports.append(GuardPort(name))
        except OSError as error:
            _say(f"guard: {name}: {error.strerror}: give a CAN interface that is up")
            return 2
    ports[0].patience = 0.0  # a program that takes no frames must not keep those to the wire waiting
    guard = BusGuard(policy, ports[0], ports[1])
    ended: list[bool] = []
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # which nohup asks for
            signal.signal(number, lambda *_: ended.append(True))
    for number in (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU):  # a terminal must not suspend it
        signal.signal(number, signal.SIG_IGN)
    _say(f"guard: {program} may command {wire} as {path} allows")
    while not ended:
        try:
            guard.step(0.2)
        except InterruptedError:
            continue
        except OSError as error:
            if not guard.closed:
                guard.close(f"an interface failed ({error.strerror})")
            time.sleep(0.2)
    if not guard.closed:
        guard.close("the guard was ended by a signal")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
