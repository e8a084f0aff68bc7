"""The stream's fan-out: each client has a short queue; a slow one loses the oldest items and delays no one else."""

import asyncio
from collections import deque

from calib.daemon.view.api_models import EventItem, JointsItem

Item = JointsItem | EventItem


class Client:
    """One client's items; used on the event loop's thread only."""

    def __init__(self, hub: "Hub") -> None:
        self._hub = hub
        self._items: deque[Item] = deque(maxlen=50)  # five seconds of joints
        self._more = asyncio.Event()

    def put(self, item: Item) -> None:
        """Add an item; if the queue is full the oldest one is lost."""
        self._items.append(item)
        self._more.set()

    async def get(self) -> Item:
        while not self._items:
            self._more.clear()
            await self._more.wait()
        return self._items.popleft()

    def close(self) -> None:
        self._hub.clients.discard(self)


class Hub:
    def __init__(self) -> None:
        self.clients: set[Client] = set()

    def subscribe(self) -> Client:
        client = Client(self)
        self.clients.add(client)
        return client

    def publish(self, item: Item) -> None:
        for client in self.clients:
            client.put(item)
