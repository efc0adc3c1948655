"""viser behind the server of the pages: a socket that only this user can open, and no tunnel to the outside."""

import asyncio
import contextlib
import importlib.metadata
import io
import os
import tempfile
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import aiohttp
from aiohttp import web
from aiohttp.typedefs import Handler

from pisigma.files.errors import OutputError

if TYPE_CHECKING:  # the full name can be resolved by type checkers at run time even without this import
    import viser

_MAX_MESSAGE = 50 * 2**20
"""Size of the largest message that viser accepts [bytes]."""
_MAX_PATH = 100
"""Longest path of a unix socket on all systems [bytes]."""
_SCENE_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'self'; base-uri 'none'"
)
"""Content security policy for viser's page, a file that contains its scripts, workers and compiled code."""
_starting = threading.Lock()


class ViserBackend:
    """A viser server on a unix socket in a folder that only this user can enter.

    viser alone has no token, does not check the origin of a page, and listens on a port, which all users of a machine
    can open.

    Attributes:
        path: path of the socket.
        server: the server, for scene and panels.
    """

    def __init__(self, label: str) -> None:
        """Start viser.

        Args:
            label: title of the panel.

        Raises:
            ImportError: viser is not installed.
            OutputError: the path of temporary files is too long for a socket.
        """
        self._client = _client()
        self._folder = tempfile.TemporaryDirectory(prefix="pisigma-")  # the folder has mode 0700
        path = Path(self._folder.name) / "viser"
        if len(os.fsencode(path)) > _MAX_PATH:
            raise OutputError(
                expected=f"a path of at most {_MAX_PATH} bytes for temporary files",
                value=str(path),
                remedy="set TMPDIR to a shorter path",
            )
        self.path = path
        self.server = _started(path, label)
        self._session: aiohttp.ClientSession | None = None

    def pages(self, folder: str) -> dict[tuple[str, str], Handler]:
        """Return the handlers of viser's page in a folder, such as "/scene"; its socket has no slash at the end."""
        return {("GET", f"{folder}/"): self._answer, ("GET", folder): self._answer}

    async def _answer(self, request: web.Request) -> web.StreamResponse:
        """Send the file of viser's page, or connect to its websocket."""
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return await self._connect(request)
        return web.Response(
            body=self._client,
            content_type="text/html",
            charset="utf-8",
            headers={"Content-Security-Policy": _SCENE_POLICY},
        )

    async def _connect(self, request: web.Request) -> web.StreamResponse:
        """Forward the messages of a websocket in both directions until one side closes it."""
        if self._session is None:
            self._session = aiohttp.ClientSession(connector=aiohttp.UnixConnector(str(self.path), limit=0))
        stated = request.headers.get("Sec-WebSocket-Protocol", "").split(",")
        protocols = [name.strip() for name in stated if name.strip()]
        outside = web.WebSocketResponse(protocols=protocols, max_msg_size=_MAX_MESSAGE, compress=False)
        async with self._session.ws_connect("http://viser/", protocols=protocols, max_msg_size=0) as inside:
            await outside.prepare(request)
            ways = [asyncio.ensure_future(_pass_on(*way)) for way in ((outside, inside), (inside, outside))]
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)
            await outside.close()
        return outside

    async def close_sockets(self) -> None:
        """Close all connections to viser."""
        if self._session is not None:
            await self._session.close()

    def close(self) -> None:
        """Stop viser and remove its socket."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
        self._folder.cleanup()


async def _pass_on(source: Any, target: Any) -> None:
    """Forward the messages of one websocket to another until the first is closed."""
    async for message in source:
        if message.type is aiohttp.WSMsgType.BINARY:
            await target.send_bytes(message.data)
        elif message.type is aiohttp.WSMsgType.TEXT:
            await target.send_str(message.data)


def _client() -> bytes:
    """Return the file of viser's page."""
    import viser

    return (Path(viser.__file__).parent / "client" / "build" / "index.html").read_bytes()


def _started(path: Path, label: str) -> "viser.ViserServer":
    """Start viser on a unix socket, without its greeting on stdout and without its tunnel to a public address.

    viser hands host and port to `websockets` and has no setting for another socket; the function of `websockets` is
    replaced while it starts.

    Raises:
        RuntimeError: this version of viser starts in another way; no server was started.
    """
    import viser
    import websockets.asyncio.server as sockets

    class Private(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            return None  # every client may ask for a tunnel, even if the button for it is missing

    serve = sockets.serve

    def serve_at_path(handler: Any, host: str, port: int, **options: Any) -> Any:
        return serve(handler, unix=True, path=str(path), **options)

    with _starting, contextlib.redirect_stdout(io.StringIO()):
        sockets.serve = serve_at_path  # type: ignore[misc, assignment]
        try:
            server = Private("127.0.0.1", 0, label=label, verbose=False)
        finally:
            sockets.serve = serve  # type: ignore[misc]
    if not path.is_socket():
        server.stop()
        raise RuntimeError(f"viser {importlib.metadata.version('viser')} does not start on a unix socket")
    return server
