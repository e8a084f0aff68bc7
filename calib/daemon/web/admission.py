"""Who may hold a connection: room for each listener, so that strangers on TCP lock nobody out, and none who is new.

On the Unix socket a newcomer takes the place of a connection that waits for its next request, of the process that holds
most. If all are being answered it waits its turn: whoever has been answered then makes room for it.
"""

import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable
from typing import Protocol

MOST_LOCAL = 256
"""Connections on the Unix socket that are answered; as many on TCP that have shown the token."""
MOST_QUEUED = 512
"""Connections on the Unix socket that wait for their turn; beyond it the oldest goes of the process that has most."""
FIRST_SECONDS = 1.0
"""Time for a connection's first request; one that has sent none by then gives way [s]."""
MOST_STRANGERS, MOST_OF_AN_ADDRESS = 64, 32
"""TCP connections that have not, in all and of one address; a further one takes the place of the oldest."""
MOST_UNSENT = 16 * 1024 * 1024
"""Bytes of answers that clients have not taken; beyond it whoever has waited longest is cut."""


class HeldConnection(Protocol):
    """One connection, as far as it matters here."""

    address: str
    """On TCP; empty on the Unix socket."""
    owner: str
    """Whose it is: the same for all connections of one process, or of one address."""

    def begin(self) -> None:
        """Read what its client sends from now on."""
        ...

    def give_way(self) -> None:
        """End it in good order: its client has asked for nothing."""
        ...

    def cut(self) -> None: ...

    def unsent(self) -> int: ...


class Admission:
    """All connections of a server."""

    def __init__(self, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._monotonic = monotonic
        self._local: set[HeldConnection] = set()
        self._idle: OrderedDict[HeldConnection, float] = OrderedDict()
        """Those on the Unix socket that wait for a request, the longest first: from when on they may have to go [s]."""
        self._queued: OrderedDict[HeldConnection, None] = OrderedDict()
        self._trusted: set[HeldConnection] = set()
        self._strangers: OrderedDict[HeldConnection, None] = OrderedDict()
        self._stuck: OrderedDict[HeldConnection, None] = OrderedDict()

    def enter(self, connection: HeldConnection) -> None:
        """Take a new connection in; it is told to `begin`, now or later."""
        if not connection.address:
            self._queued[connection] = None
            self.admit()
            if len(self._queued) > MOST_QUEUED:
                self._turn_away(_of_most(self._queued, self._queued))
            return
        same = [each for each in self._strangers if each.address == connection.address]
        if len(same) >= MOST_OF_AN_ADDRESS:
            self._turn_away(same[0])
        elif len(self._strangers) >= MOST_STRANGERS:
            self._turn_away(next(iter(self._strangers)))
        self._strangers[connection] = None
        connection.begin()

    @property
    def queue(self) -> int:
        """Number of connections that wait for their turn."""
        return len(self._queued)

    def admit(self) -> None:
        """Let in who waits, as far as there is room or others have to give way."""
        while self._queued:
            if len(self._local) >= MOST_LOCAL:
                now = self._monotonic()
                leaving = [each for each, since in self._idle.items() if since <= now]
                if not leaving:
                    return
                self._let_go(_of_most(leaving, self._local))
            held = Counter(each.owner for each in self._local)
            first = min(self._queued, key=lambda each: held[each.owner])
            del self._queued[first]
            self._local.add(first)
            self._idle[first] = self._monotonic() + FIRST_SECONDS
            first.begin()

    def asked(self, connection: HeldConnection) -> None:
        """Its client has sent a request."""
        self._idle.pop(connection, None)

    def answered(self, connection: HeldConnection) -> None:
        """Its client has got the answer, and asks for nothing else yet."""
        if connection in self._local:
            self._idle[connection] = self._monotonic()
            self.admit()

    def trust(self, connection: HeldConnection) -> bool:
        """A TCP connection has shown the token; False where there is no room for one more."""
        if connection in self._strangers:
            if len(self._trusted) >= MOST_LOCAL:
                return False
            del self._strangers[connection]
            self._trusted.add(connection)
        return True

    def stuck(self, connection: HeldConnection) -> None:
        """Its client does not take what is sent; where too much is unsent in all, who has waited longest is cut."""
        self._stuck[connection] = None
        while sum(each.unsent() for each in self._stuck) > MOST_UNSENT:
            longest, _ = self._stuck.popitem(last=False)
            longest.cut()

    def moves(self, connection: HeldConnection) -> None:
        """Its client takes what is sent again."""
        self._stuck.pop(connection, None)

    def leave(self, connection: HeldConnection) -> None:
        self._local.discard(connection)
        self._idle.pop(connection, None)
        self._queued.pop(connection, None)
        self._trusted.discard(connection)
        self._strangers.pop(connection, None)
        self._stuck.pop(connection, None)
        self.admit()

    def _let_go(self, connection: HeldConnection) -> None:
        self._local.discard(connection)
        self._idle.pop(connection, None)
        connection.give_way()

    def _turn_away(self, connection: HeldConnection) -> None:
        self._strangers.pop(connection, None)
        self._queued.pop(connection, None)
        connection.cut()


def _of_most(candidates: Iterable[HeldConnection], all_of_them: Iterable[HeldConnection]) -> HeldConnection:
    """The first of the candidates whose owner holds most."""
    held = Counter(each.owner for each in all_of_them)
    return max(candidates, key=lambda each: held[each.owner])
