"""The server: one thread that waits for all connections, and another for slow answers."""

import contextlib
import functools
import gc
import selectors
import socket
import sys
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from pisigma.deployment.serve.binary_frames import BinaryFrames
from pisigma.deployment.serve.connection import Connection
from pisigma.deployment.serve.json_lines import JsonLines
from pisigma.deployment.serve.metrics import Metrics
from pisigma.deployment.serve.models import ServedModels
from pisigma.deployment.serve.opcua import OpcUa
from pisigma.deployment.serve.polling import Polling
from pisigma.deployment.serve.protocol import AbstractProtocol
from pisigma.deployment.serve.settings import ServeSettings, is_local
from pisigma.deployment.serve.zeromq import ZeroMq
from pisigma.files.errors import OutputError

_MAX_CONNECTIONS = 512
_SWITCH_INTERVAL = 1e-4
"""Longest time for which the thread of slow answers holds the interpreter while fast answers wait [s]."""


class Server:
    """Server that answers requests until it is stopped.

    Attributes:
        json_port: port for lines of JSON.
        binary_port: port for binary frames.
        zmq: server over ZeroMQ; None if it is not used.
        opcua: server over OPC UA; None if it is not used.
        metrics: counts and durations of answers.
    """

    def __init__(self, models: ServedModels, settings: ServeSettings) -> None:
        """Start listening.

        Raises:
            OutputError: the host is not an address of this machine, a port is in use, or a required token is missing.
            ImportError: pyzmq or asyncua is required and not installed.
        """
        check_host(settings)
        self.metrics = Metrics()
        self._models, self._settings = models, settings
        self._token = None if settings.token is None else settings.token.encode()
        self._selector = selectors.DefaultSelector()
        self._connections: set[Connection] = set()
        self._listeners: list[socket.socket] = []
        self.zmq: ZeroMq | None = None
        self.opcua: OpcUa | None = None
        try:
            self.json_port = self._listen(settings.json_port, JsonLines(models, self.metrics))
            self.binary_port = self._listen(settings.binary_port, BinaryFrames(models, self.metrics))
            if settings.zmq_port is not None:
                self.zmq = self._zmq(settings.zmq_port)
            if settings.opcua:
                self.opcua = OpcUa(models, self.metrics, settings)
        except (OutputError, ImportError):
            if self.zmq is not None:
                self.zmq.stop()
            self._listen_no_more()
            self._selector.close()
            raise
        self._ready: deque[tuple[Connection, bytes]] = deque()
        self._stops = 0
        self._polling = Polling(self._selector, settings.polling)
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._selector.register(self._woken, selectors.EVENT_READ, self._take_ready)
        self._slow = ThreadPoolExecutor(1, "slow answers")

    @property
    def ports(self) -> dict[str, int]:
        """Ports of the server by protocol."""
        ports = {"json_port": self.json_port, "binary_port": self.binary_port}
        others = {"zmq_port": self.zmq, "opcua_port": self.opcua}
        return ports | {name: other.port for name, other in others.items() if other is not None}

    def run(self) -> None:
        """Answer until `stop` is called, then finish the pending requests."""
        gc.collect()
        gc.freeze()  # excludes loaded objects from garbage collection, which would take milliseconds
        switching = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_INTERVAL)
        swept, interval = time.monotonic(), self._settings.client_timeout / 10
        while not self._stops:
            self._step(interval)
            if time.monotonic() - swept > interval:
                swept = time.monotonic()
                self._sweep(swept)
        self._finish()
        sys.setswitchinterval(switching)
        gc.unfreeze()

    def stop(self) -> None:
        """Let `run` end after all received requests have been answered, or immediately if called a second time.

        It may be called from any thread or from a signal handler.
        """
        self._stops += 1
        self._notify()

    def reload(self, report_problem: Callable[[str], None]) -> None:
        """Reload the models while the old models continue to answer.

        Args:
            report_problem: function that is called with a sentence for every model that could not be loaded.
        """

        def load() -> None:
            for problem in self._models.reload():
                report_problem(problem)

        self._slow.submit(load)

    def _zmq(self, port: int) -> ZeroMq:
        return ZeroMq(self._models, self.metrics, self._settings.host, port, self._token)

    def _listen(self, port: int, protocol: AbstractProtocol) -> int:
        """Listen for a protocol at a port, and return the port."""
        host = self._settings.host
        try:
            family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            listener = socket.create_server(address, family=family, backlog=128)
        except OSError as problem:
            raise OutputError(
                f"port {port} of '{host}' cannot be used ({problem.strerror})",
                value=port,
                remedy="give a free port, or 0 for any, and an address of this machine",
            ) from None
        listener.setblocking(False)
        accept = functools.partial(self._accept, listener, protocol)
        self._selector.register(listener, selectors.EVENT_READ, accept)
        self._listeners.append(listener)
        return int(listener.getsockname()[1])

    def _accept(self, listener: socket.socket, protocol: AbstractProtocol, events: int) -> bool:
        """Accept a new connection, and return whether a client was waiting."""
        try:
            stream, _ = listener.accept()
        except OSError:
            return False
        if len(self._connections) >= _MAX_CONNECTIONS:
            self._sweep(time.monotonic())  # some of them may be closed already
        if len(self._connections) >= _MAX_CONNECTIONS:
            stream.close()
            self.metrics.cut_off += 1
            return True
        with contextlib.suppress(OSError):
            self._connections.add(Connection(stream, protocol, self._selector, self._submit, self._token))
        self.metrics.connections = len(self._connections)
        return True

    def _listen_no_more(self) -> None:
        for listener in self._listeners:
            self._selector.unregister(listener)
            listener.close()

    def _step(self, timeout: float) -> None:
        """Wait for ready connections and process them."""
        for key, events in self._polling.wait_for_connections() or self._selector.select(timeout):
            key.data(events)
        self._polling.record_activity()

    def _submit(self, connection: Connection, job: Callable[[], bytes]) -> None:
        """Compute an answer in the thread of slow answers."""

        def hand_back(done: Future[bytes]) -> None:
            if done.cancelled():
                return
            self._ready.append((connection, done.result()))
            self._notify()

        self._slow.submit(job).add_done_callback(hand_back)

    def _notify(self) -> None:
        with contextlib.suppress(OSError):  # the buffer is full, so the server is notified already
            self._wake.send(b"\0")

    def _take_ready(self, events: int) -> None:
        self._woken.recv(4096)
        while self._ready:
            connection, reply = self._ready.popleft()
            connection.send_answer(reply)

    def _sweep(self, now: float) -> None:
        """Remove closed connections, and close connections that are too slow."""
        for connection in list(self._connections):
            since = connection.waits_since
            if since is not None and now - since > self._settings.client_timeout:
                connection.close()
                self.metrics.cut_off += 1
            if connection.closed:
                self._connections.discard(connection)
        self.metrics.connections = len(self._connections)

    def _finish(self) -> None:
        """Answer all complete requests, also those of clients that are not yet accepted, then close all connections."""
        for listener in self._listeners:
            accept = self._selector.get_key(listener).data
            while accept(selectors.EVENT_READ):
                pass
        self._listen_no_more()
        for connection in self._connections:
            connection.read_remaining()
        others = [other for other in (self.zmq, self.opcua) if other is not None]
        for other in others:
            other.stop()
        while self._stops < 2 and (self._connections or any(other.is_running for other in others)):
            more = [connection.answer_remaining() for connection in self._connections]
            self._step(0.0 if any(more) else 0.05)
            self._sweep(time.monotonic())  # closes clients that do not receive their answers
        for connection in self._connections:
            connection.close()
        self._slow.shutdown(wait=False, cancel_futures=True)
        self._selector.close()
        self._wake.close()
        self._woken.close()


def check_host(settings: ServeSettings) -> None:
    """Check that only programs on this machine are served without a token.

    Raises:
        OutputError: the host is not an address, or other machines can reach it and there is no token.
    """
    if settings.token is None and not is_local(settings.host):
        raise OutputError(
            f"other machines can reach '{settings.host}', so clients must send a token",
            option="--token-file",
            remedy="give a file with a token, or serve at 127.0.0.1",
        )
    if settings.token is not None and not settings.token.strip():
        raise OutputError(
            "the token is empty",
            option="--token-file",
            value=settings.token,
            remedy="give a file with a long random token",
        )
