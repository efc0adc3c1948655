"""Interface of a server's protocols, which split a stream into messages and answer them, and values of requests."""

import hmac
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from pisigma.files.errors import RequestError
from pisigma.robot.kernels.array_kinematics import transform_entries
from pisigma.robot.kinematics.status import Status

STATUS_NAMES = {float(status): status.name.lower() for status in Status}
"""Names of statuses by their value in solutions."""
Reply = bytes | Callable[[], bytes]
"""Answer to a message, or a slow function that computes the answer and is called in another thread."""


class BrokenStreamError(Exception):
    """Error for received bytes that cannot become a message, so that later bytes cannot be interpreted either.

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
        """Return the answer to one complete message, without ever raising an error."""

    @abstractmethod
    def invalid_message_answer(self) -> bytes:
        """Return the answer to bytes that are not a message."""

    @abstractmethod
    def token_of(self, message: bytes) -> bytes | None:
        """Return the token of a first message; None if it has none."""

    @abstractmethod
    def admission_answer(self, admitted: bool) -> bytes:
        """Return the answer to a token."""


def tokens_match(received: bytes | None, expected: bytes) -> bool:
    """Return whether tokens are equal, in a time that does not depend on where they first differ."""
    return received is not None and hmac.compare_digest(received, expected)


_MAX_NUMBER = 1e9
"""Largest accepted value of a pose or joint [mm or deg]."""


def pose_entries(pose: Any, name: str) -> tuple[float, ...]:
    """Convert x, y, z [mm], roll, pitch, yaw [deg] to the 16 entries of T_base_tool [m], row by row."""
    x, y, z, *angles = read_numbers({name: pose}, name, 6)
    return transform_entries(x / 1e3, y / 1e3, z / 1e3, *map(math.radians, angles))


def read_numbers(request: dict[str, Any], key: str, count: int) -> list[float]:
    """Return a list of `count` finite numbers from the key of a request.

    Raises:
        RequestError: the value is not a list of this length, or an entry is not a finite number.
    """
    values = request[key]
    if not isinstance(values, list) or len(values) != count:
        length = len(values) if isinstance(values, list) else str(values)[:40]
        raise RequestError(expected=f"a list of {count} numbers", value=length, option=key)
    for value in values:
        if type(value) not in (float, int) or not -_MAX_NUMBER <= value <= _MAX_NUMBER:
            raise RequestError(
                expected=f"{count} numbers [mm or deg] up to {_MAX_NUMBER:g}",
                value=str(value)[:40],
                option=key,
            )
    return values


def read_tolerance(request: dict[str, Any], key: str) -> list[float] | None:
    """Return the tolerances of three axes, given as a list or as one number for all; None if not given."""
    if key not in request:
        return None
    stated = request[key]
    return read_numbers(request if isinstance(stated, list) else {key: [stated] * 3}, key, 3)


def read_branch(request: dict[str, Any]) -> str | None:
    """Read the name of a branch; None if not given."""
    branch = request.get("branch")
    if branch is None or isinstance(branch, str):
        return branch
    raise RequestError(expected="the name of a branch", value=repr(branch)[:40], option="branch")


def read_flag(request: dict[str, Any], key: str) -> bool:
    """Read a truth value; False if not given."""
    value = request.get(key, False)
    if isinstance(value, bool):
        return value
    raise RequestError(expected="true or false", value=repr(value)[:40], option=key)
