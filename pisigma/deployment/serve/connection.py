"""One connection of a server: what it has received, what it still has to send, and since when it keeps us waiting."""

import selectors
import socket
import time
from collections.abc import Callable

from pisigma.deployment.serve.protocol import AbstractProtocol, BrokenStreamError, is_token

CHUNK = 4096
"""[bytes] Are read at a time, so that no client keeps the others waiting with what it sends at once."""
MOST_REST = 2**22
"""[bytes] Are read of a client when the server stops, so that none that sends on and on keeps it."""
AT_ONCE = 100
"""Messages of a client are answered before those of others when the server stops."""

Submit = Callable[["Connection", Callable[[], bytes]], None]


class Connection:
    """A client. Its messages are answered one after the other, in their order.

    It is not read while an answer is worked out or waits for the client to take it, so that what is kept for a client
    is bounded by one message, one answer and a chunk.

    Attributes:
        closed: whether it is over.
        waits_since: `time.monotonic()` since when the rest of a message, the token, or room for an answer is
            awaited; None where nothing is.
        busy: whether an answer is worked out in another thread.
    """

    def __init__(
        self,
        stream: socket.socket,
        protocol: AbstractProtocol,
        selector: selectors.BaseSelector,
        submit: Submit,
        token: bytes | None,
    ) -> None:
        """Take a new connection.

        Args:
            stream: of the client.
            protocol: that it speaks.
            selector: that says when it can be read or written.
            submit: has an answer worked out by another thread, which ends with `take`.
            token: that its first message has to hold; None where none is wanted.
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
        selector.register(stream, self._watched, self.ready)

    def ready(self, events: int) -> None:
        """Go on: the client has sent something, or takes something."""
        try:
            if self._unsent:
                self._send(b"")
            elif events & selectors.EVENT_READ and not self._stopping:
                data = self._stream.recv(CHUNK)
                self._received += data
                self._ending = not data
            self.proceed()
        except BlockingIOError:
            pass
        except OSError:
            self.close()

    def take(self, reply: bytes) -> None:
        """Send the answer that another thread worked out, and go on."""
        self.busy = False
        if self.closed:
            return
        try:
            self._send(reply)
            self.proceed()
        except OSError:
            self.close()

    def read_rest(self) -> None:
        """Take what the client has sent before the server stops; what it sends from now on is not read."""
        self._stopping = self._ending = True
        try:
            while len(self._received) < MOST_REST and not self.closed:
                if not (data := self._stream.recv(CHUNK)):
                    break
                self._received += data
        except BlockingIOError:
            pass
        except OSError:
            self.close()

    def answer_rest(self) -> bool:
        """Answer some of what came in whole, and close after the last answer; whether there is more."""
        try:
            if not self.closed:
                self.proceed()
        except OSError:
            self.close()
        return not (self.closed or self.busy or self._unsent)

    def close(self) -> None:
        """Close at once."""
        if not self.closed:
            self.closed = True
            if self._watched:
                self._selector.unregister(self._stream)
            self._stream.close()

    def proceed(self) -> None:
        """Answer the messages that are whole, as far as answers can be sent; some of them when the server stops."""
        answered = 0
        try:
            while not self.busy and not self._unsent:
                if not self._received or not (length := self._protocol.cut(self._received)):
                    break
                if self._stopping and answered == AT_ONCE:
                    self.waits_since = None
                    return
                message = bytes(memoryview(self._received)[:length])
                del self._received[:length]
                answered += 1
                if self._token is not None:
                    self._admit(message, self._token)
                elif isinstance(reply := self._protocol.answer(message), bytes):
                    self._send(reply)
                else:
                    self.busy = True
                    self._submit(self, reply)
            if self._token is not None and len(self._received) >= CHUNK:
                raise BrokenStreamError(self._protocol.admission(False))
        except BrokenStreamError as problem:
            self._received.clear()
            self._ending = True
            self._send(problem.last_words)
        if self._ending and not self.busy and not self._unsent:
            self.close()  # what is left of a half message is dropped
        else:
            self._watch(answered > 0)

    def _admit(self, message: bytes, token: bytes) -> None:
        admitted = is_token(self._protocol.token_of(message), token)
        words = self._protocol.admission(admitted)
        if not admitted:
            raise BrokenStreamError(words)
        self._token = None
        self._send(words)

    def _send(self, reply: bytes) -> None:
        unsent = self._unsent + reply
        try:
            self._unsent = unsent[self._stream.send(unsent) :]
        except BlockingIOError:
            self._unsent = unsent

    def _watch(self, answered: bool) -> None:
        """Wait for what is needed next, and keep the time since when the client owes it."""
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
            self._selector.register(self._stream, watched, self.ready)
        else:
            self._selector.modify(self._stream, watched, self.ready)
        self._watched = watched
