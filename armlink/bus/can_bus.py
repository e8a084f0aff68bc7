"""Protocols of an open CAN bus, as the link and its listeners use it.

Adapters: python-can's interfaces (adapters.py), several buses as one (bus_group.py), buses inside this process
(in_process.py: lock-step simulation, logs).
"""

from typing import TYPE_CHECKING, Protocol, runtime_checkable

from armlink.bus.port import Port
from armlink.clock import Clock

if TYPE_CHECKING:
    import can


class CanBus(Protocol):
    @property
    def channel_info(self) -> str: ...

    @property
    def clock(self) -> Clock | None:
        """The bus's own time (simulation in lock-step, log); None if it runs in the machine's time."""

    def open_port(self, as_node: bool = False) -> Port:
        """A port to send and receive; a bus has one owner.

        `as_node` is for a node's end of the bus: it answers in the kind of frames it receives (classical or CAN FD)
        and ignores error frames.
        """

    def open_listening_port(self) -> Port:
        """A port for a listener: a StampedPort if the interface timestamps frames."""

    def shutdown(self) -> None: ...


class MessageBus(CanBus, Protocol):
    """It also gives access to all messages, extended, remote and error frames too, with their timestamps."""

    def recv(self, timeout: float | None = None) -> "can.Message | None":
        """The next message, or None after `timeout` seconds (None: wait without limit)."""


@runtime_checkable
class TimedBus(Protocol):
    """A bus whose frames have their own timestamps, such as a log."""

    @property
    def ended(self) -> bool: ...

    def stamp(self) -> float:
        """Time of the newest frame since the first [s]."""
