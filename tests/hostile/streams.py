"""Byte streams of faulty clients, and whether a server answered each of them correctly.

The stream determines the answers: every whole message once, in order, with its id, and joint values only for poses
that were sent, which they reach.
"""

import functools
import json
import math
import random
import socket
import struct
import time

import numpy as np

from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot.kernels.array_kinematics import transform_of, xyz_zyx_of

REQUEST, ANSWER, HEAD = (
    struct.Struct("<4sIQII16d8d"),
    struct.Struct("<4sIQII8d2d8s"),
    struct.Struct("<4sIQII"),
)
PROTOCOLS = ("json", "binary")
NEAR = 1e-6
"""Tolerance of the reached position [m]."""


@functools.cache
def _sources(ik: CorrectedIK) -> tuple[np.ndarray, np.ndarray]:
    """Return joint values of training rows, and their poses."""
    q = ik.model.starts.double().numpy()[:200]
    return q, np.asarray(ik.forward(q))


def good_stream(rng: random.Random, protocol: str, ik: CorrectedIK, messages: int) -> bytes:
    """Return requests for poses of training rows, with random ids."""
    parts = []
    for _ in range(messages):
        q, T = (values[rng.randrange(len(values))] for values in _sources(ik))
        name = rng.getrandbits(63)
        if protocol == "binary":
            near = [*q, *[0.0] * (8 - len(q))] if rng.random() < 0.5 else [math.nan] * 8
            parts.append(REQUEST.pack(b"PSI1", REQUEST.size, name, 0, 0, *T.ravel(), *near))
        else:
            x, y, z, *angles = xyz_zyx_of(T)
            pose = [1e3 * x, 1e3 * y, 1e3 * z, *map(math.degrees, angles)]
            parts.append(json.dumps({"id": name, "pose": pose}).encode() + b"\n")
    return b"".join(parts)


def _flip(rng: random.Random, stream: bytearray) -> None:
    for _ in range(rng.randint(1, 8)):
        stream[rng.randrange(len(stream))] ^= 1 << rng.randrange(8)


def _cut(rng: random.Random, stream: bytearray) -> None:
    del stream[rng.randrange(len(stream)) :]


def _lose(rng: random.Random, stream: bytearray) -> None:
    start = rng.randrange(len(stream))
    del stream[start : start + rng.randint(1, 300)]


def _insert(rng: random.Random, stream: bytearray) -> None:
    start = rng.randrange(len(stream))
    stream[start:start] = rng.randbytes(rng.randint(1, 300))


def _repeat(rng: random.Random, stream: bytearray) -> None:
    start = rng.randrange(len(stream))
    stream[start:start] = stream[start : start + rng.randint(1, 300)]


def _replace(rng: random.Random, stream: bytearray) -> None:
    word = rng.choice(
        (
            b"\n",
            b"\0",
            b"[" * 2000,
            b"1e999",
            b"NaN",
            b'{"id":',
            b"PSI1",
            b"\xff" * 8,
            b"-",
            b'"pose": ',
            b"\x7f\xf8",
        )
    )
    start = rng.randrange(len(stream))
    stream[start : start + rng.randint(0, 20)] = word


def _noise(rng: random.Random, stream: bytearray) -> None:
    stream[:] = rng.randbytes(rng.randint(1, 5000))


_MUTATIONS = (_flip, _cut, _lose, _insert, _repeat, _replace, _noise)


def hostile_stream(rng: random.Random, protocol: str, ik: CorrectedIK) -> bytes:
    """Return a good stream with one to three faults."""
    stream = bytearray(good_stream(rng, protocol, ik, rng.randint(1, 8)))
    for mutate in rng.choices(_MUTATIONS, k=rng.randint(1, 3)):
        if stream:
            mutate(rng, stream)
    return bytes(stream)


def exchange(rng: random.Random, port: int, stream: bytes) -> tuple[bytes, bool]:
    """Send a stream in pieces, and return the answers and whether all of them are required."""
    received = bytearray()
    with socket.create_connection(("127.0.0.1", port), 10) as connection:
        whole = rng.random() < 0.9
        try:
            rest = memoryview(stream)
            while rest:
                size = rng.randint(1, max(1, len(stream)))
                connection.sendall(rest[:size])
                rest = rest[size:]
                if rng.random() < 0.02:
                    time.sleep(0.01)
            if not whole:  # gone without a word
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                return b"", False
            connection.shutdown(socket.SHUT_WR)
        except OSError:
            whole = False  # the server ended it: what it said may be lost with what it did not read
        try:
            while data := connection.recv(65536):
                received += data
        except ConnectionResetError:
            whole = False
    return bytes(received), whole


def check(protocol: str, stream: bytes, received: bytes, whole: bool, ik: CorrectedIK) -> str | None:
    """Return a fault of the answers to a stream; None for none."""
    wanted = _frames(stream) if protocol == "binary" else _lines(stream)
    answers = _answered_frames(received) if protocol == "binary" else _answered_lines(received)
    if answers is None:
        return "the last answer is not whole" if whole else None
    if whole and len(answers) != len(wanted):
        return f"{len(wanted)} answers were due, {len(answers)} came"
    if len(answers) > len(wanted):
        return f"{len(answers)} answers came to {len(wanted)} messages"
    solved = []
    for (name, T), (answered, q) in zip(wanted, answers, strict=False):
        if answered is not None and answered != name:
            return f"an answer to {answered} came, not to {name}"
        if q is None:
            continue
        if T is None:
            return f"joint values came for {name}, which holds no pose"
        solved.append((q, T[:3, 3]))
    if solved:
        q, positions = map(np.array, zip(*solved, strict=True))
        if not np.abs(ik.forward(q)[:, :3, 3] - positions).max() < NEAR:
            return "joint values lead elsewhere than to the pose that was sent"
    return None


def _frames(stream: bytes) -> list[tuple[int, np.ndarray | None]]:
    """Return ids and poses of the whole frames; a broken one is the last."""
    wanted: list[tuple[int, np.ndarray | None]] = []
    while stream:
        if not b"PSI1".startswith(stream[:4]):
            return [*wanted, (0, None)]
        if len(stream) < HEAD.size:
            break
        _, length, name, _, flags = HEAD.unpack_from(stream)
        if length != REQUEST.size and not (flags == 1 and HEAD.size < length <= HEAD.size + 1024):
            return [*wanted, (name, None)]
        if len(stream) < length:
            break
        T = np.frombuffer(stream, "<f8", 16, HEAD.size).reshape(4, 4) if length == REQUEST.size else None
        wanted.append((name, T))
        stream = stream[length:]
    return wanted


def _lines(stream: bytes) -> list[tuple[object, np.ndarray | None]]:
    """Return ids and poses of the whole lines."""
    wanted: list[tuple[object, np.ndarray | None]] = []
    for line in stream.split(b"\n")[:-1]:
        name, T = None, None
        try:
            request = json.loads(line)
            name = request.get("id")
            pose = request["pose"]
            T = transform_of([*(value / 1e3 for value in pose[:3]), *map(math.radians, pose[3:])])
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
            pass
        wanted.append((name, T))
    return wanted


def _answered_frames(received: bytes) -> list[tuple[int, list[float] | None]] | None:
    if len(received) % ANSWER.size:
        return None
    answers = []
    for _, _, name, _, dof, *values in ANSWER.iter_unpack(received):
        answers.append((name, None if math.isnan(values[0]) else values[:dof]))
    return answers


def _answered_lines(received: bytes) -> list[tuple[object, list[float] | None]] | None:
    if received and not received.endswith(b"\n"):
        return None
    answers = []
    for line in received.split(b"\n")[:-1]:
        answer = json.loads(line)
        q = answer.get("q_deg") if "pose" not in answer else None
        answers.append((answer["id"], None if q is None else np.radians(q).tolist()))
    return answers
