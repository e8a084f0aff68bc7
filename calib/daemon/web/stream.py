"""The stream: server-sent events to many clients, each bounded; a client that does not read is cut off."""

import asyncio
import sqlite3
from collections import Counter
from contextlib import suppress

from fastapi.responses import StreamingResponse

from calib.daemon.view import ContactItem, DaemonView, EventItem, EventRecord, JointsItem
from calib.daemon.web.connection import PATIENCE_SECONDS, Receive, Scope, Send, peer_of, until_gone
from calib.daemon.web.history import Histories

MOST_CLIENTS = 200
RETRY = b"retry: 2000\n\n"
"""Browsers reconnect after two seconds."""


class Streams:
    def __init__(self, view: DaemonView) -> None:
        self._view, self.histories = view, Histories()
        self._tasks: dict[asyncio.Task[None], str] = {}
        """Whose each is, the oldest first."""
        self._item: JointsItem | None = None
        self._bytes = b""
        self._closed = False
        self.cut_off = 0
        """Number of clients cut off because they did not read."""

    @property
    def clients(self) -> int:
        return len(self._tasks)

    def make_room(self, owner: str) -> bool:
        """Whether there is room for one more of this process or address; the oldest of who holds most gives way."""
        if self.clients < MOST_CLIENTS:
            return True
        held = Counter(self._tasks.values())
        most, number = held.most_common(1)[0]
        if number <= held[owner] + 1:
            return False
        task = next(task for task, each in self._tasks.items() if each == most)
        del self._tasks[task]
        task.cancel()
        return True

    def close(self) -> None:
        """End every stream, and each that is asked for later as soon as it has begun."""
        self._closed = True
        for task in self._tasks:
            task.cancel()

    def encode(self, item: JointsItem) -> bytes:
        """A joints item as sent; encoded once for all clients that get the same one."""
        if item is not self._item:
            self._item, self._bytes = item, b"event: joints\ndata: " + item.model_dump_json().encode() + b"\n\n"
        return self._bytes

    async def run(self, scope: Scope, receive: Receive, send: Send, after: int | None) -> None:
        """Serve one client until it leaves: all events after id `after` (None: only new ones), then new items."""
        client = asyncio.create_task(self._send_all(send, after))
        self._tasks[client] = peer_of(scope).owner
        if self._closed:
            client.cancel()
        gone = asyncio.create_task(until_gone(receive))
        try:
            await asyncio.wait({client, gone}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._tasks.pop(client, None)
            for task in (client, gone):
                task.cancel()
            results = await asyncio.gather(client, gone, return_exceptions=True)
        connection = peer_of(scope).connection
        self.cut_off += connection is not None and connection.deaf
        if isinstance(results[0], Exception):
            raise results[0]
        await _send(send, b"", more=False)

    async def _send_all(self, send: Send, after: int | None) -> None:
        subscription = self._view.subscribe()
        try:
            last = self._view.status().last_event
            after = last if after is None else min(after, last)
            await _send(send, RETRY)
            after = await self._catch_up(send, after)
            while True:
                item: JointsItem | ContactItem | EventItem | None = None
                with suppress(TimeoutError):
                    async with asyncio.timeout(PATIENCE_SECONDS / 2):
                        item = await subscription.get()
                if item is None:  # is it still there?
                    await _send(send, b": nothing new\n\n")
                elif isinstance(item, JointsItem):
                    await _send(send, self.encode(item))
                elif isinstance(item, ContactItem):
                    await _send(send, b"event: contact\ndata: " + item.model_dump_json().encode() + b"\n\n")
                elif item.event.id > after:  # including those that a slow client's queue has dropped before it
                    after = await self._catch_up(send, after)
        finally:
            subscription.close()

    async def _catch_up(self, send: Send, after: int) -> int:
        """Send every event after the id; returns the newest's id."""
        while events := await self._events(after):
            for event in events:
                data = EventItem(event=event).model_dump_json().encode()
                await _send(send, b"event: event\nid: %d\ndata: %b\n\n" % (event.id, data))
                after = event.id
        return after

    async def _events(self, after: int) -> tuple[EventRecord, ...]:
        """Empty where they cannot be read now: they come with the next one."""
        with suppress(sqlite3.Error):
            return await self.histories.short(lambda: self._view.events(after=after))
        return ()


class StreamResponse(StreamingResponse):
    def __init__(self, streams: Streams, after: int | None) -> None:
        """Begin with the events after id `after`; None: only new ones."""
        super().__init__((), media_type="text/event-stream", headers={"x-accel-buffering": "no"})
        self._streams, self._after = streams, after

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": self.raw_headers})
        await self._streams.run(scope, receive, send, self._after)


async def _send(send: Send, data: bytes, more: bool = True) -> None:
    await send({"type": "http.response.body", "body": data, "more_body": more})
