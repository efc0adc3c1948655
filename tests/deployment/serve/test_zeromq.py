"""The same requests over ZeroMQ."""

import json
import math
import sys
import time

import pytest
from testing.closeness import assert_close
from testing.serving import client, json_client, running

from pisigma.deployment.serve.settings import ServeSettings
from pisigma.files.errors import missing_extra
from pisigma.robot.kernels.array_kinematics import transform_of

zmq = pytest.importorskip("zmq", reason="pyzmq is not installed")

POSE = [800.0, 200.0, 600.0, 0.0, -90.0, 180.0]
LINE = json.dumps({"id": 1, "pose": POSE}).encode()
MATRIX = transform_of([0.8, 0.2, 0.6, 0.0, -math.pi / 2, math.pi]).ravel()
FRAME = client.REQUEST.pack(b"PSI1", 216, 7, 0, 0, *MATRIX, *[math.nan] * 8)


@pytest.fixture
def asking():
    """Return a function that connects a socket of a kind to a server and sends requests."""
    context = zmq.Context()
    sockets = []

    def connect(server, kind):
        socket = context.socket(kind)
        sockets.append(socket)
        socket.setsockopt(zmq.RCVTIMEO, 5000)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(f"tcp://127.0.0.1:{server.ports['zmq_port']}")

        def ask(*parts):
            socket.send_multipart(parts)
            (answer,) = socket.recv_multipart()
            return client.ANSWER.unpack(answer) if answer.startswith(b"PSI1") else json.loads(answer)

        return ask

    yield connect
    for socket in sockets:
        socket.close()
    context.term()


def test_lines_and_frames_get_the_answers_of_tcp(asking, repository):
    with running(repository / "models" / "kiro4", settings=ServeSettings(zmq_port=0)) as server:
        with json_client(server) as lines:
            wanted = lines.ask(pose=POSE)
        for kind in (zmq.REQ, zmq.DEALER):
            ask = asking(server, kind)
            assert ask(LINE) == wanted
            assert ask(LINE + b"\n") == wanted
            _, _, name, status, dof, *values = ask(FRAME)
            assert (name, status, dof) == (7, 0, 6)
            assert_close([math.degrees(q) for q in values[:6]], wanted["q_deg"], atol=1e-9)
            for broken in (b"", b"[]", LINE + b"\n" + LINE, b"x", b"\xff"):
                assert "error" in ask(broken)
            for broken in (FRAME[:-1], FRAME + b"x", b"PSI1"):
                assert ask(broken)[3] == 102
            assert "error" in ask(b"secret", LINE)
            assert ask(LINE) == wanted


def test_every_message_needs_the_token(asking, repository):
    settings = ServeSettings("0.0.0.0", zmq_port=0, token="secret")
    with running(repository / "models" / "kiro4", settings=settings) as server:
        ask = asking(server, zmq.REQ)
        assert ask(b"secret", LINE)["status"] == "reached"
        assert ask(b"secret", FRAME)[3] == 0
        assert ask(b"wrong", FRAME)[3] == 103
        for parts in ((LINE,), (b"wrong", LINE), (b"secret", b"secret", LINE)):
            assert ask(*parts)["error"].startswith("token: ")


@pytest.mark.parametrize(
    ("module", "extra", "options"), [("zmq", "serve", {"zmq_port": 0}), ("asyncua", "opcua", {"opcua": True})]
)
def test_a_missing_extra_is_named(monkeypatch, repository, module, extra, options):
    monkeypatch.setitem(sys.modules, module, None)
    with (
        pytest.raises(ImportError) as caught,
        running(repository / "models" / "kiro4", settings=ServeSettings(**options)),
    ):
        pass
    assert f'pip install "pisigma[{extra}]"' in str(missing_extra(caught.value))


@pytest.fixture
def unread():
    """Return a function that connects a socket to a server and sends many messages before it reads an answer."""
    context = zmq.Context()
    sockets = []

    def send(server, messages, **queues):
        socket = context.socket(zmq.DEALER)
        sockets.append(socket)
        options = {"SNDHWM": 0, "RCVHWM": 0, "LINGER": 0, "RCVTIMEO": 20_000} | queues
        for name, value in options.items():
            socket.setsockopt(getattr(zmq, name), value)
        socket.connect(f"tcp://127.0.0.1:{server.ports['zmq_port']}")
        socket.send(LINE)
        socket.recv()
        for message in messages:
            socket.send(message)
        return socket

    yield send
    for socket in sockets:
        socket.close()
    context.term()


def test_all_received_messages_are_answered_when_the_server_stops(unread, repository):
    """More messages than fit into a queue of ZeroMQ."""
    with running(repository / "models" / "kiro4", settings=ServeSettings(zmq_port=0)) as server:
        socket = unread(server, 2000 * [LINE])
        socket.recv()
    for _ in range(1999):
        socket.recv()


def test_a_slow_reader_gets_every_answer_and_one_that_never_reads_delays_nobody(unread, repository):
    """Answers wait for a client that reads late; by default ROUTER sockets drop them silently."""
    small = {"RCVHWM": 1, "RCVBUF": 4096}
    padded = json.dumps({"id": int(4000 * "1"), "pose": POSE}).encode()
    with running(repository / "models" / "kiro4", settings=ServeSettings(zmq_port=0)) as server:
        slow = unread(server, 1000 * [padded], **small)
        time.sleep(0.5)
        for _ in range(1000):
            slow.recv()
        unread(server, 2000 * [padded], **small)
        for _ in range(50):
            slow.send(LINE)
            slow.recv()
