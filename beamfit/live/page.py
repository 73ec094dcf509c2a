"""Web page of a watch: local by default, GET only, without external content.

The page subscribes to server-sent events and shows every text as plain text.
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

# Largest number of simultaneous readers, and largest request in bytes.
MAX_READERS = 16
MAX_REQUEST = 8192
# Longest time to receive a request or to send an event, s.
TIMEOUT = 5.0
TYPES = {"/": "text/html; charset=utf-8", "/state": "application/json"}
STATUS_TEXTS = {200: "OK", 400: "Bad Request", 403: "Forbidden", 404: "Not Found"}
STATUS_TEXTS |= {405: "Method Not Allowed", 503: "Service Unavailable"}


def _policy(page: str) -> str:
    """Make the security policy of the page, which allows only its own script, style and server."""

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
        f"HTTP/1.1 {status} {STATUS_TEXTS[status]}", f"Content-Type: {kind}",
        "Cache-Control: no-store", "X-Content-Type-Options: nosniff",
        "Referrer-Policy: no-referrer", "Connection: close",
        "Cross-Origin-Resource-Policy: same-origin", f"Content-Security-Policy: {policy}",
    ]  # fmt: skip
    lines += [] if length is None else [f"Content-Length: {length}"]
    lines += ["Allow: GET"] if status == 405 else []
    return "\r\n".join([*lines, "", ""]).encode()


class Page:
    """Page of a watch, with its readers and the last event."""

    def __init__(self, address: str) -> None:
        self.text = files("beamfit.live").joinpath("watch.html").read_text("utf-8")
        self.policy = _policy(self.text)
        self.last = b"{}"
        self.news = asyncio.Event()
        self.readers = 0
        # On a loopback address only such host names are accepted, against DNS rebinding.
        self.is_local = ipaddress.ip_address(address).is_loopback

    def show(self, view: WatchView) -> None:
        """Send a view to every reader."""
        self.last = json.dumps(view.to_json(), allow_nan=False).encode()
        self.news.set()
        self.news = asyncio.Event()

    async def answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one request."""
        if self.readers > 4 * MAX_READERS:
            writer.close()
            return
        self.readers += 1
        try:
            async with asyncio.timeout(TIMEOUT):
                head = await reader.readuntil(b"\r\n\r\n")
            status, path = self._status_and_path(head.decode("latin-1"))
            if status == 200 and path == "/events":
                await self._events(writer)
                return
            body = {"/": self.text.encode(), "/state": self.last}.get(path, b"")
            body = body if status == 200 else f"{status} {STATUS_TEXTS[status]}\n".encode()
            kind = TYPES[path] if status == 200 else "text/plain"
            writer.write(_head(status, kind, len(body), self.policy) + body)
            async with asyncio.timeout(TIMEOUT):
                await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # the reader is gone or too slow
        except asyncio.CancelledError:
            pass  # the watch ends; Python 3.11 would report the cancelled stream task
        finally:
            self.readers -= 1
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()

    def _status_and_path(self, head: str) -> tuple[int, str]:
        """Return status and path of a request."""
        first, *rest = head.split("\r\n")
        named = [line[5:].strip() for line in rest if line.lower().startswith("host:")]
        words = first.split(" ")
        if len(words) != 3 or len(named) != 1:
            return 400, ""
        if words[0] != "GET":
            return 405, ""
        host = re.sub(r":\d+$", "", named[0]).strip("[]")
        if self.is_local and host != "localhost" and not _loopback(host):
            return 403, ""
        if words[1] not in (*TYPES, "/events"):
            return 404, ""
        return (503 if self.readers > MAX_READERS else 200), words[1]

    async def _events(self, writer: asyncio.StreamWriter) -> None:
        writer.write(_head(200, "text/event-stream", None, self.policy))
        while not writer.is_closing():
            news = self.news
            writer.write(b"data: " + self.last + b"\n\n")
            async with asyncio.timeout(TIMEOUT):
                await writer.drain()
            await news.wait()


def _loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@asynccontextmanager
async def page(address: str, port: int) -> AsyncIterator[tuple[str, Callable[[WatchView], None]]]:
    """Serve the page inside the context.

    Parameters
    ----------
    address : str
        Address of the network interface to listen on; 127.0.0.1 is this computer only.
    port : int
        Port; 0 for any free one.

    Yields
    ------
    str, callable
        Address of the page, and a function that takes the present view.

    Raises
    ------
    InputError
        If address or port cannot be used.
    """
    try:
        one = Page(address)
        server = await asyncio.start_server(one.answer, address, port, limit=MAX_REQUEST)
    except (OSError, ValueError) as error:
        found = f"a page that cannot be served on {address}, port {port} ({error})"
        raise InputError(found, "a free --port, and an address of this computer") from None
    where, at = server.sockets[0].getsockname()[:2]
    host = f"[{where}]" if ":" in where else where
    try:
        yield f"http://{host}:{at}/", one.show
    finally:
        server.close()
