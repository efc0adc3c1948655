"""What the protocols of a server have in common: cutting a stream into messages, and answering one."""

import hmac
from abc import ABC, abstractmethod
from collections.abc import Callable

from pisigma.robot.kinematics.status import Status

STATUS_NAMES = {float(status): status.name.lower() for status in Status}
"""Of statuses as solutions hold them."""
Reply = bytes | Callable[[], bytes]
"""The answer to a message, or what gives it when it is called in a thread that may take its time."""


class BrokenStreamError(Exception):
    """What came is no message and never becomes one, so nothing behind it can be trusted either.

    Attributes:
        last_words: the answer to send before the connection is closed.
    """

    def __init__(self, last_words: bytes) -> None:
        super().__init__()
        self.last_words = last_words


class AbstractProtocol(ABC):
    """How bytes become messages, and messages answers. One object serves all connections."""

    @abstractmethod
    def cut(self, received: bytearray) -> int:
        """Give the length of the first message in what was received; 0 as long as it is not whole.

        Raises:
            BrokenStreamError: it never becomes a message.
        """

    @abstractmethod
    def answer(self, message: bytes) -> Reply:
        """Answer one whole message; whatever it holds, nothing is raised."""

    @abstractmethod
    def broken(self) -> bytes:
        """Say that what came is no message."""

    @abstractmethod
    def token_of(self, message: bytes) -> bytes | None:
        """The token that a first message holds; None where it holds none."""

    @abstractmethod
    def admission(self, admitted: bool) -> bytes:
        """Say whether a token was the right one."""


def is_token(given: bytes | None, wanted: bytes) -> bool:
    """Compare tokens in a time that does not depend on where they differ."""
    return given is not None and hmac.compare_digest(given, wanted)
