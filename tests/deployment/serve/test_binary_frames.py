"""Binary frames have the numbers of Python, byte by byte as documented."""

import math
import socket
import struct

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.serving import client, frame_client

import pisigma
from pisigma.files.model_files import model_hash
from pisigma.robot.kernels.array_kinematics import transform_of

T = transform_of([0.8, 0.2, 0.6, 0.2, -1.4, 3.0])
NEAR = np.array([0.3, 0.05, -0.02, -1.5, 0.3, 1.6])


@pytest.fixture(scope="module")
def frames(served):
    with frame_client(served) as connected:
        yield connected


def _request(name=1, index=0, flags=0, pose=T, near=(math.nan,) * 8, magic=b"PSI1", length=216):
    return struct.pack("<4sIQII16d8d", magic, length, name, index, flags, *np.ravel(pose), *near)


@pytest.fixture
def raw(served):
    """Send bytes, and return all answers."""

    def exchange(sent):
        with socket.create_connection(("127.0.0.1", served.binary_port), 5) as stream:
            stream.sendall(sent)
            stream.shutdown(socket.SHUT_WR)
            with stream.makefile("rb") as file:
                received = file.read()
        return [
            client.ANSWER.unpack_from(received, start)
            for start in range(0, len(received), client.ANSWER.size)
        ]

    return exchange


@pytest.mark.parametrize(("index", "name"), [(0, "kiro4"), (1, "kiro3")])
def test_a_frame_is_answered_with_the_numbers_of_python(frames, repository, index, name):
    ik = pisigma.load(repository / "models" / name)
    near = NEAR[: len(ik.joints)]
    pose = ik.forward(near)
    status, q, residuals = frames.solve(pose.ravel(), near, index)
    solution = ik(pose, near=near)
    assert status == solution.status
    assert frames.sha256 == model_hash(repository / "models" / name)[:16]
    assert_close(q, solution.q)
    assert_close(residuals, [solution.position_residual, solution.rotation_residual])
    assert_close(frames.solve(pose.ravel(), model=index)[1], ik(pose).q)


def test_statuses_without_joint_values(frames):
    far = T.copy()
    far[0, 3] = 9.0
    for pose, near, wanted in (
        (far, None, pisigma.Status.UNREACHABLE),
        (2 * T, None, pisigma.Status.INVALID_POSE),
        (T, [math.inf] * 6, pisigma.Status.INVALID_POSE),
        (T, [0.1, math.nan, 0, 0, 0, 0], pisigma.Status.INVALID_POSE),
        (T, [0.1, 100.0, 0, 0, 0, 0], pisigma.Status.INVALID_POSE),
    ):
        status, q, residuals = frames.solve(pose.ravel(), near)
        assert status == wanted
        assert np.isnan([*q, *residuals]).all()


def test_many_frames_are_answered_in_order(raw):
    answers = raw(b"".join(_request(name) for name in range(2**63, 2**63 + 100)))
    assert [answer[2] for answer in answers] == list(range(2**63, 2**63 + 100))
    assert len({answer[3:12] for answer in answers if not answer[3]}) >= 1


@pytest.mark.parametrize(
    ("sent", "statuses"),
    [
        (_request(index=2), [100]),
        (_request(flags=2), [101]),
        (_request() + _request(magic=b"PSI2") + _request(), [0, 102]),
        (_request(length=215) + _request(), [102]),
        (b"GET / HTTP/1.1\r\n\r\n", [102]),
        (_request()[:-1], []),
        (_request() + _request()[:200], [0]),
    ],
)
def test_invalid_requests_are_never_answered_with_joint_values(raw, sent, statuses):
    answers = raw(sent)
    assert [answer[3] for answer in answers] == statuses
    for answer in answers:
        assert (answer[3] < 100) == (not math.isnan(answer[5]))
