"""Server of a page, in a thread; it is the only server of the page that listens on a port."""

import asyncio
import contextlib
import errno
import os
import socket
import threading
from collections.abc import Awaitable, Callable, Mapping

from aiohttp import web
from aiohttp.typedefs import Handler

from pisigma.files.errors import OutputError
from pisigma.workbench.server.access import MAX_UPLOAD, Access

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
