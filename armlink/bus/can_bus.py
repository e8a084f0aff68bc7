"""A CAN bus that is open: what the link and its listeners need of it, whatever it is made of.

Adapters: python-can's interfaces (adapters.py), several buses as one (bus_group.py), buses inside this process
(in_process.py: lock-step simulation, logs).
"""

from typing import TYPE_CHECKING, Protocol, runtime_checkable

from armlink.bus.port import Port
from armlink.clock import Clock

if TYPE_CHECKING:
    import can


class CanBus(Protocol):
    """An open bus."""

    @property
    def channel_info(self) -> str:
        """Its name for messages."""
        ...

    @property
    def clock(self) -> Clock | None:
        """The bus's own time if it has one (simulation in lock-step, a log), None if it is the machine's."""
        ...

    def open_port(self, as_node: bool = False) -> Port:
        """A port to send and receive by; one bus has one owner.

        `as_node` is for a node's end of the bus: it answers in the kind of frames that it hears (classical, CAN FD)
        and takes no notice of error frames.
        """
        ...

    def open_listening_port(self) -> Port:
        """A port for one who only listens: a StampedPort if the interface stamps frames."""
        ...

    def shutdown(self) -> None:
        """Close the bus and its ports."""
        ...


class MessageSource(Protocol):
    """A bus whose messages can be had as they are: extended, remote and error frames, with the interface's times."""

    @property
    def channel_info(self) -> str:
        """Its name for messages."""
        ...

    @property
    def clock(self) -> Clock | None:
        """The bus's own time, as of CanBus."""
        ...

    def recv(self, timeout: float | None = None) -> "can.Message | None":
        """The next message, or None after `timeout` seconds (None: wait without limit)."""
        ...

    def shutdown(self) -> None:
        """Close the bus."""
        ...


class MessageBus(CanBus, MessageSource, Protocol):
    """A bus of python-can's."""


@runtime_checkable
class TimedBus(Protocol):
    """A bus whose frames bear times of their own, such as a log's."""

    @property
    def ended(self) -> bool:
        """Whether no frame will come any more."""
        ...

    def stamp(self) -> float:
        """When the newest frame came, since the first [s]."""
        ...
