"""The daemon's page and API served on a socket of its own."""

import asyncio
import contextlib
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from playwright.sync_api import Browser, Page

from calib.daemon.view import DaemonView
from calib.daemon.web.server import serve

TOKEN = "a-token-for-tests-only"


@dataclass
class Served:
    """A running server; `do` runs something on its event loop, which is the only thread that may touch the view."""

    path: Path
    port: int
    loop: asyncio.AbstractEventLoop

    def do(self, act: Callable[[], Any]) -> Any:
        async def call() -> Any:
            return act()

        return asyncio.run_coroutine_threadsafe(call(), self.loop).result(30)

    def client(self, **options: Any) -> httpx.Client:
        """On the Unix socket."""
        return httpx.Client(
            transport=httpx.HTTPTransport(uds=str(self.path)), base_url="http://localhost", timeout=30, **options
        )

    def tcp(self, token: str | None = TOKEN) -> httpx.Client:
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        return httpx.Client(base_url=self.url, headers=headers, timeout=30)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def served(
    make_view: Callable[[], DaemonView], path: Path, beside: Callable[[], Awaitable[None]] | None = None
) -> Iterator[Served]:
    """Serve a view, made on the event loop's thread, until the end of the block; `beside` runs on the same loop."""
    loop, port, ready = asyncio.new_event_loop(), free_port(), threading.Event()

    async def main() -> None:
        web = asyncio.create_task(serve(make_view(), socket=path, tcp=("127.0.0.1", port), token=TOKEN))
        work = [web]
        try:
            while not web.done():
                with contextlib.suppress(OSError):
                    _, writer = await asyncio.open_unix_connection(str(path))
                    writer.close()
                    break
                await asyncio.sleep(0)
            ready.set()
            work += [] if beside is None else [asyncio.create_task(beside())]
            await asyncio.gather(*work)
        finally:
            for task in work:
                if not task.cancelling():  # a second time would break off the server's end
                    task.cancel()
            await asyncio.gather(*work, return_exceptions=True)

    running = loop.create_task(main())

    def run() -> None:
        with contextlib.suppress(asyncio.CancelledError):
            loop.run_until_complete(running)
        loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert ready.wait(300)
        yield Served(path, port, loop)
    finally:
        loop.call_soon_threadsafe(running.cancel)
        thread.join(60)
    assert not thread.is_alive()


def open_page(browser: Browser, server: Served, width: int = 1200, token: str = TOKEN, **options: Any) -> Page:
    """The page over TCP, its token given; `page.complaints` is what its scripts complained of."""
    context = browser.new_context(viewport={"width": width, "height": 900}, timezone_id="UTC", **options)
    page = context.new_page()
    page.complaints = []  # type: ignore[attr-defined]
    page.on("pageerror", lambda error: page.complaints.append(str(error)))  # type: ignore[attr-defined]
    page.on("console", lambda m: m.type == "error" and "401" not in m.text and page.complaints.append(m.text))  # type: ignore[attr-defined]
    page.goto(server.url)
    page.fill("#token", token)
    page.click("#ask-token button")
    return page
