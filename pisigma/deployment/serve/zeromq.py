"""Requests over ZeroMQ: a message is a line of JSON, with or without its line end, or a binary frame."""

import threading

from pisigma.deployment.serve.binary_frames import MAGIC, BinaryFrames
from pisigma.deployment.serve.connection import MAX_DRAIN_BYTES
from pisigma.deployment.serve.json_lines import MAX_LINE_BYTES, JsonLines
from pisigma.deployment.serve.metrics import Metrics
from pisigma.deployment.serve.models import ServedModels
from pisigma.deployment.serve.protocol import AbstractProtocol, BrokenStreamError, tokens_match
from pisigma.files.errors import OutputError

_SILENCE_MS = 500
"""Time without a message after which all messages sent before the stop are regarded as received [ms]."""
_SEND_TIMEOUT_MS = 2000
"""Longest time to wait for a client that does not read its answers before an answer is dropped [ms]."""
_MAX_QUEUED = 100
"""Largest number of messages of a client, and of answers to it, in a queue."""


class ZeroMq:
    """A ROUTER socket in a separate thread, for any number of REQ and DEALER sockets.

    Attributes:
        port: port of the socket.
    """

    def __init__(
        self, models: ServedModels, metrics: Metrics, host: str, port: int, token: bytes | None
    ) -> None:
        """Start listening.

        Args:
            models: models of the server.
            metrics: counters of the answers.
            host: address of this machine.
            port: port to listen on; 0 for a free port.
            token: token in a separate part before every message; None if no token is required.

        Raises:
            ImportError: pyzmq is not installed.
            OutputError: the port is in use.
        """
        try:
            import zmq
        except ImportError as problem:
            raise ImportError(str(problem), name="pyzmq") from None
        self._json, self._binary = JsonLines(models, metrics), BinaryFrames(models, metrics)
        self._token, self._context = token, zmq.Context(1)
        self._socket, self._stopping = self._context.socket(zmq.ROUTER), threading.Event()
        options = {
            zmq.LINGER: _SEND_TIMEOUT_MS,
            zmq.MAXMSGSIZE: MAX_LINE_BYTES,
            zmq.RCVTIMEO: _SILENCE_MS,
            zmq.SNDTIMEO: _SEND_TIMEOUT_MS,
            zmq.IPV6: int(":" in host),
            zmq.RCVHWM: _MAX_QUEUED,
            zmq.SNDHWM: _MAX_QUEUED,
            # otherwise a ROUTER silently drops answers when the queue is full
            zmq.ROUTER_MANDATORY: 1,
        }
        for option, value in options.items():
            self._socket.setsockopt(option, value)
        try:
            self._socket.bind(f"tcp://{f'[{host}]' if ':' in host else host}:{port or '*'}")
        except zmq.ZMQError as problem:
            self._close()
            raise OutputError(
                f"port {port} of '{host}' cannot be used by ZeroMQ ({problem.strerror})",
                value=port,
                option="--zmq-port",
                remedy="give a free port, or 0 for any",
            ) from None
        self.port = int(self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        self._again, self._no_wait, self._unreachable = zmq.Again, zmq.DONTWAIT, zmq.ZMQError
        self._not_reading: set[bytes] = set()
        self._thread = threading.Thread(target=self._run, name="ZeroMQ", daemon=True)
        self._thread.start()

    @property
    def is_running(self) -> bool:
        """Whether the thread is still answering."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """Let the thread answer all received messages, then close the socket."""
        self._stopping.set()

    def _run(self) -> None:
        drained = 0
        while drained < MAX_DRAIN_BYTES:
            stopping = self._stopping.is_set()  # set before reading, so that earlier messages are answered
            try:
                # waits also when stopping, because the next messages of a full queue take a moment
                client, *parts = self._socket.recv_multipart()
            except self._again:
                if stopping:
                    break
                continue
            drained += sum(map(len, parts)) if stopping else 0
            envelope = [client, b""] if len(parts) > 1 and not parts[0] else [client]
            self._send(client, [*envelope, self._reply(parts[len(envelope) - 1 :])])
        self._close()

    def _send(self, client: bytes, parts: list[bytes]) -> None:
        """Send parts, waiting only once for a client that does not read, so that other clients are not delayed."""
        try:
            self._socket.send_multipart(parts, self._no_wait if client in self._not_reading else 0)
            self._not_reading.discard(client)
        except self._again:
            self._not_reading.add(client)
        except self._unreachable:  # the client has disconnected
            self._not_reading.discard(client)

    def _reply(self, parts: list[bytes]) -> bytes:
        """Return the answer to the parts of a message after its envelope: a token, if required, and the request."""
        message = parts[-1] if parts else b""
        protocol: AbstractProtocol = self._binary if message.startswith(MAGIC) else self._json
        if len(parts) != (1 if self._token is None else 2) or (
            self._token is not None and not tokens_match(parts[0], self._token)
        ):
            return protocol.admission_answer(False)
        if protocol is self._json:
            message = message.removesuffix(b"\n") + b"\n"
        try:
            if protocol.message_length(bytearray(message)) != len(message):
                return protocol.invalid_message_answer()
        except BrokenStreamError as problem:
            return problem.final_answer
        reply = protocol.answer_message(message)
        return reply if isinstance(reply, bytes) else reply()

    def _close(self) -> None:
        self._socket.close()
        self._context.term()
