"""The server: one thread that waits for all connections at once, and another for what takes its time."""

import contextlib
import functools
import gc
import ipaddress
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
from pisigma.deployment.serve.polling import Polling
from pisigma.deployment.serve.protocol import AbstractProtocol
from pisigma.deployment.serve.settings import ServeSettings
from pisigma.deployment.serve.zeromq import ZeroMq
from pisigma.files.errors import OutputError

MOST_CONNECTIONS = 512
SWITCHING = 1e-4
"""[s] A thread that works out a path holds the interpreter at most, while quick answers wait for it."""


class Server:
    """Answers requests until it is stopped.

    Attributes:
        json_port: where lines of JSON are answered.
        binary_port: where binary frames are answered.
        zmq: the answers over ZeroMQ, if they are wanted.
        metrics: what was answered.
    """

    def __init__(self, models: ServedModels, settings: ServeSettings) -> None:
        """Listen.

        Raises:
            OutputError: the host is no address of this machine, a port is taken, or a token is wanted and missing.
            ImportError: pyzmq is wanted and not installed.
        """
        check_host(settings)
        self.metrics = Metrics()
        self._models, self._settings = models, settings
        self._token = None if settings.token is None else settings.token.encode()
        self._selector = selectors.DefaultSelector()
        self._connections: set[Connection] = set()
        self._listeners: list[socket.socket] = []
        try:
            self.json_port = self._listen(settings.json_port, JsonLines(models, self.metrics))
            self.binary_port = self._listen(settings.binary_port, BinaryFrames(models, self.metrics))
            self.zmq = None if settings.zmq_port is None else self._zmq(settings.zmq_port)
        except (OutputError, ImportError):
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
        """Where the server listens, by protocol."""
        ports = {"json_port": self.json_port, "binary_port": self.binary_port}
        return ports if self.zmq is None else ports | {"zmq_port": self.zmq.port}

    def run(self) -> None:
        """Answer until `stop`, then finish what was begun."""
        gc.collect()
        gc.freeze()  # what is loaded is never looked through again, which would take milliseconds
        switching = sys.getswitchinterval()
        sys.setswitchinterval(SWITCHING)
        swept, interval = time.monotonic(), self._settings.patience / 10
        while not self._stops:
            self._turn(interval)
            if time.monotonic() - swept > interval:
                swept = time.monotonic()
                self._sweep(swept)
        self._finish()
        sys.setswitchinterval(switching)
        gc.unfreeze()

    def stop(self) -> None:
        """Have `run` end when all that came in is answered, or the second time at once.

        From any thread, or a signal's handler.
        """
        self._stops += 1
        self._notify()

    def reload(self, report: Callable[[str], None]) -> None:
        """Load the models again, meanwhile answering with the old ones.

        Args:
            report: gets a sentence for every model that could not be loaded.
        """

        def load() -> None:
            for problem in self._models.reload():
                report(problem)

        self._slow.submit(load)

    def _zmq(self, port: int) -> ZeroMq:
        return ZeroMq(self._models, self.metrics, self._settings.host, port, self._token)

    def _listen(self, port: int, protocol: AbstractProtocol) -> int:
        """Have a protocol answered at a port; gives the port."""
        host = self._settings.host
        try:
            family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            listener = socket.create_server(address, family=family, backlog=128)
        except OSError as problem:
            raise OutputError(
                f"port {port} of '{host}' cannot be served ({problem.strerror}); give a free port, or 0 for any, and "
                "an address of this machine."
            ) from None
        listener.setblocking(False)
        accept = functools.partial(self._accept, listener, protocol)
        self._selector.register(listener, selectors.EVENT_READ, accept)
        self._listeners.append(listener)
        return int(listener.getsockname()[1])

    def _accept(self, listener: socket.socket, protocol: AbstractProtocol, events: int) -> bool:
        """Take a new connection; whether there was one."""
        try:
            stream, _ = listener.accept()
        except OSError:
            return False
        if len(self._connections) >= MOST_CONNECTIONS:
            self._sweep(time.monotonic())  # some of them may be closed
        if len(self._connections) >= MOST_CONNECTIONS:
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

    def _turn(self, timeout: float) -> None:
        """Wait for connections, and go on with those that can."""
        for key, events in self._polling.ready() or self._selector.select(timeout):
            key.data(events)
        self._polling.went_on()

    def _submit(self, connection: Connection, job: Callable[[], bytes]) -> None:
        """Have an answer worked out beside the others."""

        def hand_back(done: Future[bytes]) -> None:
            if done.cancelled():
                return
            self._ready.append((connection, done.result()))
            self._notify()

        self._slow.submit(job).add_done_callback(hand_back)

    def _notify(self) -> None:
        with contextlib.suppress(OSError):  # it is full: somebody has done it already
            self._wake.send(b"\0")

    def _take_ready(self, events: int) -> None:
        self._woken.recv(4096)
        while self._ready:
            connection, reply = self._ready.popleft()
            connection.take(reply)

    def _sweep(self, now: float) -> None:
        """Forget connections that are closed, and cut off those that are too slow."""
        for connection in list(self._connections):
            since = connection.waits_since
            if since is not None and now - since > self._settings.patience:
                connection.close()
                self.metrics.cut_off += 1
            if connection.closed:
                self._connections.discard(connection)
        self.metrics.connections = len(self._connections)

    def _finish(self) -> None:
        """Answer what has come in whole, from clients that wait to be accepted too, then close everything."""
        for listener in self._listeners:
            accept = self._selector.get_key(listener).data
            while accept(selectors.EVENT_READ):
                pass
        self._listen_no_more()
        for connection in self._connections:
            connection.read_rest()
        if self.zmq is not None:
            self.zmq.stop()
        while self._stops < 2 and (self._connections or (self.zmq is not None and self.zmq.is_running)):
            more = [connection.answer_rest() for connection in self._connections]
            self._turn(0.0 if any(more) else 0.05)
            self._sweep(time.monotonic())  # who does not take an answer is not waited for
        for connection in self._connections:
            connection.close()
        self._slow.shutdown(wait=False, cancel_futures=True)
        self._selector.close()
        self._wake.close()
        self._woken.close()


def check_host(settings: ServeSettings) -> None:
    """Make sure that only programs of this machine are served without a token.

    Raises:
        OutputError: the host is no address, or others reach it and there is no token.
    """
    try:
        addresses = {
            str(entry[4][0]) for entry in socket.getaddrinfo(settings.host, 0, type=socket.SOCK_STREAM)
        }
    except OSError as problem:
        raise OutputError(
            f"'{settings.host}' is no address of this machine ({problem.strerror}); give 127.0.0.1, or 0.0.0.0 for all."
        ) from None
    if settings.token is None and not all(ipaddress.ip_address(one).is_loopback for one in addresses):
        raise OutputError(
            f"other machines reach '{settings.host}', so clients have to send a token; give its file with "
            "--token-file, or serve at 127.0.0.1."
        )
    if settings.token is not None and not settings.token.strip():
        raise OutputError("the token is empty; give one that nobody guesses.")
