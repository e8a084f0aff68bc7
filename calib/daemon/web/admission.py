"""Who may hold a connection: room for each listener, so that strangers on TCP lock nobody out."""

from collections import OrderedDict
from typing import Protocol

MOST_LOCAL = 256
"""Connections on the Unix socket."""
MOST_TRUSTED = 256
"""TCP connections that have shown the token."""
MOST_STRANGERS, MOST_OF_AN_ADDRESS = 64, 32
"""TCP connections that have not, in all and of one address; a further one takes the place of the oldest."""
MOST_UNSENT = 16 * 1024 * 1024
"""Bytes of answers that clients have not taken; beyond it whoever has waited longest is cut."""


class Connection(Protocol):
    """One connection, as far as it matters here."""

    address: str
    """On TCP; empty on the Unix socket."""

    def cut(self) -> None:
        """End it at once."""
        ...

    def unsent(self) -> int:
        """Bytes that its client has not taken."""
        ...


class Admission:
    """All connections of a server."""

    def __init__(self) -> None:
        self._local: set[Connection] = set()
        self._trusted: set[Connection] = set()
        self._strangers: OrderedDict[Connection, None] = OrderedDict()
        self._stuck: OrderedDict[Connection, None] = OrderedDict()
        self.turned_away = 0
        """Connections that were cut to make room, or had none."""

    def enter(self, connection: Connection) -> bool:
        """Take a new connection in; False where there is no room for it."""
        if not connection.address:
            if len(self._local) >= MOST_LOCAL:
                self.turned_away += 1
                return False
            self._local.add(connection)
            return True
        same = [each for each in self._strangers if each.address == connection.address]
        if len(same) >= MOST_OF_AN_ADDRESS:
            self._turn_away(same[0])
        elif len(self._strangers) >= MOST_STRANGERS:
            self._turn_away(next(iter(self._strangers)))
        self._strangers[connection] = None
        return True

    def trust(self, connection: Connection) -> bool:
        """A TCP connection has shown the token; False where there is no room for one more."""
        if connection in self._strangers:
            if len(self._trusted) >= MOST_TRUSTED:
                return False
            del self._strangers[connection]
            self._trusted.add(connection)
        return True

    def stuck(self, connection: Connection) -> None:
        """Its client does not take what is sent; where too much is unsent in all, who has waited longest is cut."""
        self._stuck[connection] = None
        while sum(each.unsent() for each in self._stuck) > MOST_UNSENT:
            longest, _ = self._stuck.popitem(last=False)
            longest.cut()

    def moves(self, connection: Connection) -> None:
        """Its client takes what is sent again."""
        self._stuck.pop(connection, None)

    def leave(self, connection: Connection) -> None:
        """It has ended."""
        self._local.discard(connection)
        self._trusted.discard(connection)
        self._strangers.pop(connection, None)
        self._stuck.pop(connection, None)

    def _turn_away(self, connection: Connection) -> None:
        self.turned_away += 1
        self._strangers.pop(connection)
        connection.cut()
