"""Interface of a server's protocols, which cut a stream into messages and answer them."""

import hmac
from abc import ABC, abstractmethod
from collections.abc import Callable

from pisigma.robot.kinematics.status import Status

STATUS_NAMES = {float(status): status.name.lower() for status in Status}
"""Names of statuses by their value in solutions."""
Reply = bytes | Callable[[], bytes]
"""The answer to a message, or a slow function that computes it and is called in another thread."""


class BrokenStreamError(Exception):
    """The received bytes cannot become a message, so later bytes cannot be interpreted either.

    Attributes:
        final_answer: answer to send before the connection is closed.
    """

    def __init__(self, final_answer: bytes) -> None:
        super().__init__()
        self.final_answer = final_answer


class AbstractProtocol(ABC):
    """Conversion of bytes to messages and of messages to answers. One object serves all connections."""

    @abstractmethod
    def message_length(self, received: bytearray) -> int:
        """Return the length of the first message in the received bytes; 0 while it is incomplete.

        Raises:
            BrokenStreamError: the bytes cannot become a message.
        """

    @abstractmethod
    def answer_message(self, message: bytes) -> Reply:
        """Answer one complete message; never raises an error."""

    @abstractmethod
    def invalid_message_answer(self) -> bytes:
        """Return the answer to bytes that are not a message."""

    @abstractmethod
    def token_of(self, message: bytes) -> bytes | None:
        """Return the token of a first message; None if it has none."""

    @abstractmethod
    def admission_answer(self, admitted: bool) -> bytes:
        """Return the answer to a token."""


def tokens_match(given: bytes | None, wanted: bytes) -> bool:
    """Compare tokens in a time that does not depend on where they differ."""
    return given is not None and hmac.compare_digest(given, wanted)
