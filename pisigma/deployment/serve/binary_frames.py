"""Requests and answers as frames of fixed length, for poses in control loops."""

import enum
import math
import struct
import time

from pisigma.deployment.serve.metrics import Metrics
from pisigma.deployment.serve.models import ServedModel, ServedModels
from pisigma.deployment.serve.protocol import STATUS_NAMES, AbstractProtocol, BrokenStreamError, Reply
from pisigma.files.errors import RequestError

MAGIC = b"PSI1"
JOINTS = 8
"""Number of joint values in every frame, regardless of the robot."""
HEAD = struct.Struct("<4sIQII")
"""Format of the header: magic, length of the whole frame, id; then model index and flags, or status and number of
joints."""
REQUEST = struct.Struct(f"<4sIQII16d{JOINTS}d")
"""Format of requests: the pose T_base_tool row by row [m], and joint values near which the solution should be [rad or
m] (NaN for none)."""
_POSE, _NEAR = HEAD.size, HEAD.size + 128
ANSWER = struct.Struct(f"<4sIQII{JOINTS}d2d8s")
"""Format of answers: joint values [rad or m], NaN after the last joint, the residuals of position [m] and rotation
[rad], and the first bytes of the SHA-256 of the model, 0 if no model answered."""
_MAX_TOKEN_BYTES = 1024

TOKEN = 1
"""Flag of a first frame that has a token after its header."""


class Refusal(enum.IntEnum):
    """Statuses of answers in addition to `Status`."""

    NO_SUCH_MODEL = 100
    UNKNOWN_FLAGS = 101
    BROKEN_FRAME = 102
    WRONG_TOKEN = 103
    DEFECT = 104
    MODEL_REFUSED = 105


_NO_JOINTS = (math.nan,) * JOINTS


class BinaryFrames(AbstractProtocol):
    """Protocol with one frame per request and answer; see docs/reference/serve-protocol.md."""

    def __init__(self, models: ServedModels, metrics: Metrics) -> None:
        self._models, self._metrics = models, metrics

    def message_length(self, received: bytearray) -> int:
        """Return the length of the first frame; see `AbstractProtocol`.

        Raises:
            BrokenStreamError: the magic or the length is wrong.
        """
        count = len(received)
        if not received.startswith(MAGIC[:count]):
            raise BrokenStreamError(self.invalid_message_answer())
        if count < HEAD.size:
            return 0
        _, length, name, _, flags = HEAD.unpack_from(received)
        fits = (
            HEAD.size < length <= HEAD.size + _MAX_TOKEN_BYTES if flags == TOKEN else length == REQUEST.size
        )
        if not fits:
            raise BrokenStreamError(_refusal(name, Refusal.BROKEN_FRAME))
        return length if count >= length else 0

    def answer_message(self, message: bytes) -> Reply:
        """Answer a frame."""
        begun = time.perf_counter_ns()
        _, _, name, index, flags = HEAD.unpack_from(message)
        if flags:
            return self._refuse(name, Refusal.UNKNOWN_FLAGS, begun)
        try:
            model = self._models.find_model(index)
        except RequestError:
            why = Refusal.MODEL_REFUSED if self._models.is_use_forbidden else Refusal.NO_SUCH_MODEL
            return self._refuse(name, why, begun)
        if model.has_compiled_solver:
            return self._solve(model, message, name, begun)
        return lambda: self._solve(model, message, name, begun)

    def invalid_message_answer(self) -> bytes:
        """Return the answer to bytes that are not a frame."""
        return _refusal(0, Refusal.BROKEN_FRAME)

    def token_of(self, message: bytes) -> bytes | None:
        """Return the bytes after the header of a frame with the flag `TOKEN`."""
        return message[HEAD.size :] if HEAD.unpack_from(message)[4] == TOKEN else None

    def admission_answer(self, admitted: bool) -> bytes:
        """Return the answer to a token: status 0 if it is valid."""
        return _refusal(0, 0 if admitted else Refusal.WRONG_TOKEN)

    def _solve(self, model: ServedModel, message: bytes, name: int, begun: int) -> bytes:
        try:
            dof = len(model.ik.joints)
            row = model.solve(message[_POSE:_NEAR], message[_NEAR : _NEAR + 8 * dof])
            position, rotation, _, status, _ = row[2 * dof :]
            q = *row[:dof], *_NO_JOINTS[dof:]
            numbers = *q, position, rotation
            reply = ANSWER.pack(MAGIC, ANSWER.size, name, int(status), dof, *numbers, model.short_hash)
        except Exception:
            return self._refuse(name, Refusal.DEFECT, begun)
        self._metrics.count(STATUS_NAMES[status], begun)
        return reply

    def _refuse(self, name: int, why: Refusal, begun: int) -> bytes:
        self._metrics.count("refused", begun)
        return _refusal(name, why)


def _refusal(name: int, status: int) -> bytes:
    return ANSWER.pack(MAGIC, ANSWER.size, name, status, 0, *_NO_JOINTS, math.nan, math.nan, b"")
