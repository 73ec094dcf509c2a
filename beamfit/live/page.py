"""A watch as one web page: this computer alone unless asked, nothing but GET, nothing from outside.

The page asks for its events (server-sent) and shows every text as text.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import ipaddress
import json
import re
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from importlib.resources import files

from beamfit.errors import InputError
from beamfit.live.watch import WatchView

# Readers at a time, bytes of a request, and s within which it has to come and an event to go.
MOST, LONGEST, WAIT = 16, 8192, 5.0
TYPES = {"/": "text/html; charset=utf-8", "/state": "application/json"}
SAID = {200: "OK", 400: "Bad Request", 403: "Forbidden", 404: "Not Found"}
SAID |= {405: "Method Not Allowed", 503: "Service Unavailable"}


def _policy(page: str) -> str:
    """Security policy of the page: its own script, its own style, its own server."""

    def digest(tag: str) -> str:
        [inside] = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        return base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode()

    return (
        f"default-src 'none'; script-src 'sha256-{digest('script')}'; style-src "
        f"'sha256-{digest('style')}'; img-src data:; connect-src 'self'; base-uri 'none'; "
        "form-action 'none'; frame-ancestors 'none'"
    )


def _head(status: int, kind: str, length: int | None, policy: str) -> bytes:
    lines = [
        f"HTTP/1.1 {status} {SAID[status]}", f"Content-Type: {kind}", "Cache-Control: no-store",
        "X-Content-Type-Options: nosniff", "Referrer-Policy: no-referrer", "Connection: close",
        "Cross-Origin-Resource-Policy: same-origin", f"Content-Security-Policy: {policy}",
    ]  # fmt: skip
    lines += [] if length is None else [f"Content-Length: {length}"]
    lines += ["Allow: GET"] if status == 405 else []
    return "\r\n".join([*lines, "", ""]).encode()


class Page:
    """The page, its readers, and the last event."""

    def __init__(self, address: str) -> None:
        self.text = files("beamfit.live").joinpath("watch.html").read_text("utf-8")
        self.policy = _policy(self.text)
        self.last = b"{}"
        self.news = asyncio.Event()
        self.readers = 0
        # A page of another site that has its own name point here does not know this one's.
        self.here = ipaddress.ip_address(address).is_loopback

    def show(self, told: WatchView) -> None:
        """Tell every reader."""
        self.last = json.dumps(told.to_json(), allow_nan=False).encode()
        self.news.set()
        self.news = asyncio.Event()

    async def answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One request."""
        if self.readers > 4 * MOST:
            writer.close()
            return
        self.readers += 1
        try:
            async with asyncio.timeout(WAIT):
                head = await reader.readuntil(b"\r\n\r\n")
            status, path = self._asked(head.decode("latin-1"))
            if status == 200 and path == "/events":
                await self._events(writer)
                return
            body = {"/": self.text.encode(), "/state": self.last}.get(path, b"")
            body = body if status == 200 else f"{status} {SAID[status]}\n".encode()
            kind = TYPES[path] if status == 200 else "text/plain"
            writer.write(_head(status, kind, len(body), self.policy) + body)
            async with asyncio.timeout(WAIT):
                await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # a reader that went, or is too slow
        except asyncio.CancelledError:
            pass  # the watch ends; streams of Python 3.11 tell of a task that says so itself
        finally:
            self.readers -= 1
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()

    def _asked(self, head: str) -> tuple[int, str]:
        """Answer to a request: a status, and the path."""
        first, *rest = head.split("\r\n")
        named = [line[5:].strip() for line in rest if line.lower().startswith("host:")]
        words = first.split(" ")
        if len(words) != 3 or len(named) != 1:
            return 400, ""
        if words[0] != "GET":
            return 405, ""
        host = re.sub(r":\d+$", "", named[0]).strip("[]")
        if self.here and host != "localhost" and not _loopback(host):
            return 403, ""
        if words[1] not in (*TYPES, "/events"):
            return 404, ""
        return (503 if self.readers > MOST else 200), words[1]

    async def _events(self, writer: asyncio.StreamWriter) -> None:
        writer.write(_head(200, "text/event-stream", None, self.policy))
        while not writer.is_closing():
            news = self.news
            writer.write(b"data: " + self.last + b"\n\n")
            async with asyncio.timeout(WAIT):
                await writer.drain()
            await news.wait()


def _loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@asynccontextmanager
async def page(address: str, port: int) -> AsyncIterator[tuple[str, Callable[[WatchView], None]]]:
    """Serve the page while the block lasts.

    Parameters
    ----------
    address : str
        Of the network interface that is listened on; 127.0.0.1 is this computer alone.
    port : int
        0 for any that is free.

    Yields
    ------
    str, callable
        Where the page is, and what is to be given what is known.

    Raises
    ------
    InputError
        If nobody can listen there.
    """
    try:
        one = Page(address)
        server = await asyncio.start_server(one.answer, address, port, limit=LONGEST)
    except (OSError, ValueError) as error:
        found = f"a page that cannot be served on {address}, port {port} ({error})"
        raise InputError(found, "a free --port, and an address of this computer") from None
    where, at = server.sockets[0].getsockname()[:2]
    host = f"[{where}]" if ":" in where else where
    try:
        yield f"http://{host}:{at}/", one.show
    finally:
        server.close()
