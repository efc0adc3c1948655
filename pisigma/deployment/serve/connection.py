"""One connection of a server: received and unsent bytes, and the time of the oldest awaited byte."""

import selectors
import socket
import time
from collections.abc import Callable

from pisigma.deployment.serve.protocol import AbstractProtocol, BrokenStreamError, tokens_match

CHUNK = 4096
"""Largest number of bytes that are read at a time, so that no client delays others with long messages."""
MAX_DRAIN_BYTES = 2**22
"""Largest number of bytes that are read from a client when the server stops, so that no client can delay the stop."""
_MESSAGES_PER_TURN = 100
"""Number of messages of a client that are answered in one turn when the server stops."""

Submit = Callable[["Connection", Callable[[], bytes]], None]


class Connection:
    """Connection to a client, whose messages are answered one at a time, in order.

    It is not read while an answer is computed or waits to be received by the client, so the memory per client is
    limited to one message, one answer and a chunk.

    Attributes:
        closed: whether the connection is closed.
        waits_since: `time.monotonic()` since which the remainder of a message, the token, or space for an answer has
            been awaited; None if nothing is awaited from the client.
        busy: whether another thread is computing an answer.
    """

    def __init__(
        self,
        stream: socket.socket,
        protocol: AbstractProtocol,
        selector: selectors.BaseSelector,
        submit: Submit,
        token: bytes | None,
    ) -> None:
        """Accept a new connection of a client.

        Args:
            stream: socket of the client.
            protocol: protocol of the client.
            selector: selector that reports when the socket can be read or written.
            submit: function that makes another thread compute an answer and pass it to `send_answer`.
            token: token that the first message must have; None if no token is required.
        """
        stream.setblocking(False)
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._stream, self._protocol, self._selector, self._submit = stream, protocol, selector, submit
        self._token = token
        self._received, self._unsent = bytearray(), b""
        self._ending = self._stopping = self.closed = self.busy = False
        self.waits_since = time.monotonic() if token is not None else None
        self._watched = selectors.EVENT_READ
        selector.register(stream, self._watched, self.handle_events)

    def handle_events(self, events: int) -> None:
        """Read and answer messages after the client has sent bytes or can receive bytes."""
        try:
            if self._unsent:
                self._send(b"")
            elif events & selectors.EVENT_READ and not self._stopping:
                data = self._stream.recv(CHUNK)
                self._received += data
                self._ending = not data
            self.answer_messages()
        except BlockingIOError:
            pass
        except OSError:
            self.close()

    def send_answer(self, reply: bytes) -> None:
        """Send the answer that another thread computed, and continue."""
        self.busy = False
        if self.closed:
            return
        try:
            self._send(reply)
            self.answer_messages()
        except OSError:
            self.close()

    def read_remaining(self) -> None:
        """Read the bytes that the client has sent before the server stops; later bytes are not read."""
        self._stopping = self._ending = True
        try:
            while len(self._received) < MAX_DRAIN_BYTES and not self.closed:
                if not (data := self._stream.recv(CHUNK)):
                    break
                self._received += data
        except BlockingIOError:
            pass
        except OSError:
            self.close()

    def answer_remaining(self) -> bool:
        """Answer some complete messages, close the connection after the last one, and return whether there are more."""
        try:
            if not self.closed:
                self.answer_messages()
        except OSError:
            self.close()
        return not (self.closed or self.busy or self._unsent)

    def close(self) -> None:
        """Close immediately."""
        if not self.closed:
            self.closed = True
            if self._watched:
                self._selector.unregister(self._stream)
            self._stream.close()

    def answer_messages(self) -> None:
        """Answer the complete messages as far as answers can be sent; when the server stops, only a few at a time."""
        answered = 0
        try:
            while not self.busy and not self._unsent:
                if not self._received or not (length := self._protocol.message_length(self._received)):
                    break
                if self._stopping and answered == _MESSAGES_PER_TURN:
                    self.waits_since = None
                    return
                message = bytes(memoryview(self._received)[:length])
                del self._received[:length]
                answered += 1
                if self._token is not None:
                    self._admit(message, self._token)
                elif isinstance(reply := self._protocol.answer_message(message), bytes):
                    self._send(reply)
                else:
                    self.busy = True
                    self._submit(self, reply)
            if self._token is not None and len(self._received) >= CHUNK:
                raise BrokenStreamError(self._protocol.admission_answer(False))
        except BrokenStreamError as problem:
            self._received.clear()
            self._ending = True
            self._send(problem.final_answer)
        if self._ending and not self.busy and not self._unsent:
            self.close()  # an incomplete message is dropped
        else:
            self._watch(answered > 0)

    def _admit(self, message: bytes, token: bytes) -> None:
        admitted = tokens_match(self._protocol.token_of(message), token)
        reply = self._protocol.admission_answer(admitted)
        if not admitted:
            raise BrokenStreamError(reply)
        self._token = None
        self._send(reply)

    def _send(self, reply: bytes) -> None:
        unsent = self._unsent + reply
        try:
            self._unsent = unsent[self._stream.send(unsent) :]
        except BlockingIOError:
            self._unsent = unsent

    def _watch(self, answered: bool) -> None:
        """Wait for the next event, and store the time since which the client owes it."""
        watched = 0 if self.busy else selectors.EVENT_WRITE if self._unsent else selectors.EVENT_READ
        owed = not self.busy and bool(self._unsent or self._received or self._token is not None)
        if not owed:
            self.waits_since = None
        elif self.waits_since is None or answered or watched != self._watched:
            self.waits_since = time.monotonic()
        if watched == self._watched:
            return
        if not watched:
            self._selector.unregister(self._stream)
        elif not self._watched:
            self._selector.register(self._stream, watched, self.handle_events)
        else:
            self._selector.modify(self._stream, watched, self.handle_events)
        self._watched = watched
