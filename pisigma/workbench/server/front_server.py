"""Server of a page, in a thread, and who may open the page; no other server of the page listens on a port.

Access needs the token in the link, then a cookie, and only pages of the same origin have it.
"""

import asyncio
import contextlib
import errno
import ipaddress
import os
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from html import escape
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Handler

from pisigma.files.errors import OutputError

_MAX_PORTS = 1000
"""Number of ports that are tried."""
_CLOSING_TIME = 1.0
"""Time for open requests to finish when the server ends [s]."""


class FrontServer:
    """Server of pages until it is closed.

    Attributes:
        url: link with the token.
        origin: start of the link, such as "http://127.0.0.1:8080".
    """

    def __init__(
        self,
        pages: Mapping[tuple[str, str], Handler],
        host: str,
        port: int,
        closing: Callable[[], Awaitable[None]] | None = None,
    ) -> None:
        """Start serving.

        Args:
            pages: functions that answer a method and a path in the folder of the pages, such as ("GET", "/").
            host: address to listen on; at 127.0.0.1 only this machine can open the pages.
            port: port to listen on; if it is in use, the next free port.
            closing: function that is called in the thread of the server when it ends.

        Raises:
            OutputError: the host is not an address of this machine, or no port is free.
        """
        self._socket = _bound(host, port)
        access = Access()
        app = web.Application(middlewares=[access.guard], client_max_size=MAX_UPLOAD)
        app.router.add_get("/open/{token}", access.open_link)
        for (method, path), handler in pages.items():
            app.router.add_route(method, access.root + path, handler)
        number = self._socket.getsockname()[1]
        self.origin = f"http://{f'[{host}]' if ':' in host else host}:{number}"
        self.url = f"{self.origin}/open/{access.token}"
        self._loop, self._started = asyncio.new_event_loop(), threading.Event()
        self._thread = threading.Thread(target=self._run, args=(app, closing), daemon=True)
        self._thread.start()
        self._started.wait()

    def _run(self, app: web.Application, closing: Callable[[], Awaitable[None]] | None) -> None:
        """Serve in this thread until `close`."""
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=_CLOSING_TIME)
        self._loop.run_until_complete(runner.setup())
        self._loop.run_until_complete(web.SockSite(runner, self._socket).start())
        self._loop.call_soon(self._started.set)
        self._loop.run_forever()
        self._loop.run_until_complete(runner.cleanup())
        if closing is not None:
            self._loop.run_until_complete(closing())
        self._loop.run_until_complete(_end_tasks())
        self._loop.close()

    def close(self) -> None:
        """Stop serving."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()


async def _end_tasks() -> None:
    """Cancel the remaining tasks of closed connections."""
    left = asyncio.all_tasks() - {asyncio.current_task()}
    for task in left:
        task.cancel()
    await asyncio.gather(*left, return_exceptions=True)


def _bound(host: str, port: int) -> socket.socket:
    """Return a socket at the first free port.

    Raises:
        OutputError: the host is not an address of this machine, or no port is free.
    """
    for number in range(port, min(port + _MAX_PORTS, 2**16)):
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0]
            with contextlib.ExitStack() as unless_bound:
                bound = unless_bound.enter_context(socket.socket(family, kind))
                if os.name == "posix":  # on Windows, two servers would otherwise share the port
                    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                bound.bind(address)
                bound.listen()
                unless_bound.pop_all()
            return bound
        except OSError as problem:
            if problem.errno == errno.EADDRINUSE:
                continue
            raise OutputError(
                f"the page cannot be served at '{host}': {problem.strerror}",
                value=host,
                option="--host",
                remedy="give an address of this machine, such as 127.0.0.1, or 0.0.0.0 for all of them",
            ) from None
    raise OutputError("no port is free", value=port, option="--port", remedy="give another port")


_COOKIE = "pisigma"
MAX_UPLOAD = 200 * 2**20
"""Largest body of a request [bytes]."""
_SAFE_METHODS = ("GET", "HEAD")
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; frame-src 'self'; form-action 'self'; frame-ancestors 'self'; base-uri 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""Headers of every response, which forbid loading from other servers, storing, and display inside foreign pages."""
_FORBIDDEN = "Open this page with the link that pisigma printed."


def _random_name() -> str:
    return secrets.token_urlsafe(32)


@dataclass(frozen=True)
class Access:
    """Secrets of one server: the link with the token sets a cookie, which every other request needs.

    A browser sends the cookies of a host to the servers at all ports of it, including those of other users. The cookie
    is therefore restricted to a folder with a random name, in which all pages are.

    Attributes:
        token: secret in the link.
        cookie: secret in the cookie.
        random_folder: random name of the folder of all pages.
    """

    token: str = field(default_factory=_random_name)
    cookie: str = field(default_factory=_random_name)
    random_folder: str = field(default_factory=_random_name)

    @property
    def root(self) -> str:
        """Path of the folder, without a slash at its end."""
        return f"/{self.random_folder}"

    async def open_link(self, request: web.Request) -> web.Response:
        """Answer the link: set the cookie, and forward the browser to the first page.

        A redirect would belong to the navigation from the foreign page with the link, for which browsers send no strict
        cookie; therefore the answer is a page that forwards the browser immediately.
        """
        if not secrets.compare_digest(
            request.match_info["token"].encode(errors="replace"), self.token.encode()
        ):
            raise web.HTTPForbidden(text=_FORBIDDEN)
        page = (
            '<!doctype html><title>pisigma</title><link rel="icon" href="data:,">'
            f'<meta http-equiv="refresh" content="0;url={self.root}/">'
        )
        response = web.Response(text=page, content_type="text/html")
        response.set_cookie(_COOKIE, self.cookie, path=self.root, httponly=True, samesite="Strict")
        return response

    def check(self, request: web.Request) -> None:
        """Check host, origin and cookie of a request.

        Raises:
            HTTPForbidden: the request comes from another page, or from a browser without the cookie.
        """
        if not is_local_host(request.host):
            raise web.HTTPForbidden(text=f"The host {escape(request.host)[:100]} is not this machine.")
        if request.match_info.get("token") is not None:
            return
        cookie = request.cookies.get(_COOKIE, "")
        if not secrets.compare_digest(cookie.encode(errors="replace"), self.cookie.encode()):
            raise web.HTTPForbidden(text=_FORBIDDEN)
        if not is_same_origin(request):
            raise web.HTTPForbidden(text="The request comes from another page.")

    @web.middleware
    async def guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Check a request, have it answered, and add the headers to the response."""
        try:
            self.check(request)
            if (request.content_length or 0) > MAX_UPLOAD:
                raise web.HTTPRequestEntityTooLarge(MAX_UPLOAD, request.content_length or 0)
            response = await handler(request)
        except web.HTTPException as refusal:
            for name, value in _HEADERS.items():
                refusal.headers.setdefault(name, value)
            raise
        if not response.prepared:
            for name, value in _HEADERS.items():
                response.headers.setdefault(name, value)
        return response


def is_local_host(host: str) -> bool:
    """Return whether a Host header names this machine by an address or by a name that only this machine has.

    A foreign page whose host name was made to resolve to this machine (DNS rebinding) is recognised by that name.
    """
    name = ""
    with contextlib.suppress(ValueError):
        name = urlsplit(f"//{host}").hostname or ""
        ipaddress.ip_address(name)
        return True
    return name in ("localhost", socket.gethostname().lower())


def is_same_origin(request: web.Request) -> bool:
    """Return whether a request was made by a page of this server, or by a person who typed the address."""
    origin = request.headers.get("Origin")
    is_socket = request.headers.get("Upgrade", "").lower() == "websocket"
    if origin is None and (is_socket or request.method not in _SAFE_METHODS):
        return False
    if origin is not None and origin.partition("://")[2].lower() != request.host.lower():
        return False
    return request.headers.get("Sec-Fetch-Site", "none") in ("none", "same-origin")
