"""The server as a whole: tokens, slow clients, changed models, and shutdown."""

import contextlib
import json
import re
import shutil
import socket
import threading
import time

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.coupled import coupled_robot
from testing.models import no_type_checker
from testing.refusals import refused
from testing.serving import frame_client, json_client, running

import pisigma
from pisigma.deployment.serve import connection, json_lines
from pisigma.deployment.serve.models import ServedModels, model_folders
from pisigma.deployment.serve.server import Server
from pisigma.deployment.serve.settings import ServeSettings
from pisigma.files.errors import ModelError, OutputError
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import save_model

POSE = [800.0, 200.0, 600.0, 10.0, -80.0, 170.0]


@pytest.fixture(scope="module")
def kiro4(repository):
    return repository / "models" / "kiro4"


def test_other_machines_are_served_with_a_token_only(kiro4):
    models = ServedModels([kiro4])
    for host in ("0.0.0.0", "::"):
        with refused(OutputError, option="--token-file", value=None):
            Server(models, ServeSettings(host))
    with refused(OutputError, option="--host", value="no.such.host.invalid"):
        Server(models, ServeSettings("no.such.host.invalid"))
    with refused(OutputError, option="--token-file", value=" "):
        Server(models, ServeSettings("0.0.0.0", token=" "))


def test_a_port_in_use_is_refused(served, kiro4):
    with refused(OutputError, value=served.json_port):
        Server(ServedModels([kiro4]), ServeSettings(json_port=served.json_port))


def test_nothing_is_answered_before_the_token(kiro4):
    with running(kiro4, settings=ServeSettings("0.0.0.0", token="secret")) as server:
        with json_client(server, token="secret") as client:
            assert client.ask(pose=POSE)["status"] == "reached"
        with frame_client(server, token="secret") as client:
            assert client.solve([1.0] * 16)[0] == 6
        for token in (None, "Secret", ""):
            with (
                pytest.raises(RuntimeError, match=r"^token: "),
                json_client(server, token=token) as client,
            ):
                client.ask(pose=POSE)
        with pytest.raises(ConnectionError), frame_client(server, token="wrong"):
            pass
        with socket.create_connection(("127.0.0.1", server.json_port), 5) as stranger:
            stranger.sendall(b"x" * 4096)  # no more is stored of a client without a token
            assert b'"error": "token: ' in stranger.recv(1000)
            assert stranger.recv(1000) == b""


def test_slow_clients_are_cut_off_and_the_others_served(kiro4):
    with running(kiro4, settings=ServeSettings(client_timeout=0.2)) as server, json_client(server) as waiting:
        stalled = [socket.create_connection(("127.0.0.1", server.json_port), 5) for _ in range(20)]
        for stream in stalled:
            stream.sendall(b'{"id": 1, "pose": [')
        for stream in stalled:
            assert stream.recv(100) == b""
            stream.close()
        assert waiting.ask(pose=POSE)["status"] == "reached"
        assert waiting.ask(ask="health")["cut_off"] == 20


def _send_for_ever(stream, line):
    while True:
        stream.sendall(line)


def test_a_client_that_does_not_read_answers_is_cut_off(kiro4):
    with running(kiro4, settings=ServeSettings(client_timeout=0.2)) as server, json_client(server) as other:
        greedy = socket.create_connection(("127.0.0.1", server.json_port), 5)
        line = b'{"ask": "models"}\n' * 1000
        with pytest.raises(OSError, match=r"Broken pipe|reset|timed out"):
            _send_for_ever(greedy, line)
        greedy.close()
        assert other.ask(ask="health")["cut_off"] == 1


def test_a_rewritten_model_is_reloaded_without_dropping_a_request(kiro4, repository, tmp_path):
    shutil.copytree(kiro4, tmp_path / "arm")
    with running(tmp_path / "arm", within=tmp_path) as server, json_client(server) as client:
        before = client.ask(ask="models")["models"]
        answered, stop = [], threading.Event()

        def call():
            with json_client(server) as beside:
                while not stop.is_set():
                    answered.append(beside.ask(pose=POSE, model=0)["status"])

        thread = threading.Thread(target=call)
        thread.start()
        shutil.copytree(repository / "models" / "kiro3", tmp_path / "other")
        text = (tmp_path / "arm" / "model.yaml").read_text()
        (tmp_path / "arm" / "model.yaml").write_text(text.replace("name: kiro4", "name: kiro4b", 1))
        answer = client.ask(ask="reload")
        stop.set()
        thread.join()
        assert set(answered) == {"reached"}
        after = client.ask(ask="models")["models"]
        assert [model["name"] for model in after] == ["arm", "other"]
        assert answer["problems"] or after[0]["sha256"] != before[0]["sha256"]
        (tmp_path / "arm" / "model.yaml").unlink()
        assert "model.yaml" in client.ask(ask="reload")["problems"][0]
        assert client.ask(pose=POSE, model="arm")["status"] == "reached"


def test_pending_requests_are_finished_when_the_server_stops(kiro4, monkeypatch):
    begun = threading.Event()
    follow = json_lines._follow

    def slowly(*arguments):
        begun.set()
        time.sleep(0.3)
        return follow(*arguments)

    monkeypatch.setattr(json_lines, "_follow", slowly)
    with running(kiro4) as server:
        stream = socket.create_connection(("127.0.0.1", server.json_port), 5)
        path = json.dumps({"id": 1, "path": [POSE] * 3}).encode() + b"\n"
        pose = json.dumps({"id": 2, "pose": POSE}).encode() + b"\n"
        stream.sendall(path + pose)
        assert begun.wait(5)
    with stream, stream.makefile("rb") as file:
        assert [json.loads(line)["id"] for line in file] == [1, 2]


def test_all_complete_requests_are_answered_when_the_server_stops(kiro4):
    """Many requests of several clients, one of them not accepted yet, and an incomplete request."""
    with running(kiro4) as server:
        streams = [socket.create_connection(("127.0.0.1", server.json_port), 5) for _ in range(3)]
        lines = [json.dumps({"id": i, "pose": POSE}).encode() + b"\n" for i in range(200)]
        for stream in streams:
            stream.sendall(b"".join(lines) + b'{"id": 200, ')
    for stream in streams:
        with stream, stream.makefile("rb") as file:
            assert [json.loads(line)["id"] for line in file] == list(range(200))


def test_a_client_that_keeps_sending_delays_neither_the_server_nor_the_others(kiro4, monkeypatch):
    monkeypatch.setattr(connection, "MAX_DRAIN_BYTES", 20_000)
    line = json.dumps({"id": 1, "pose": POSE}).encode() + b"\n"
    with running(kiro4) as server:
        greedy = socket.create_connection(("127.0.0.1", server.json_port), 5)

        def read():
            with contextlib.suppress(OSError):
                while greedy.recv(1 << 16):
                    pass

        def send():
            with contextlib.suppress(OSError):
                _send_for_ever(greedy, 100 * line)

        threads = [threading.Thread(target=one) for one in (read, send)]
        for thread in threads:
            thread.start()
        quiet = socket.create_connection(("127.0.0.1", server.json_port), 5)
        quiet.sendall(line)
    with quiet, quiet.makefile("rb") as file:
        assert [json.loads(line)["id"] for line in file] == [1]
    for thread in threads:
        thread.join(5)
    greedy.close()
    assert not any(thread.is_alive() for thread in threads)


def test_the_second_stop_aborts_slow_answers(kiro4, monkeypatch):
    begun, go_on = threading.Event(), threading.Event()
    monkeypatch.setattr(json_lines, "_follow", lambda *arguments: begun.set() or go_on.wait(10))
    with (
        running(kiro4) as server,
        socket.create_connection(("127.0.0.1", server.json_port), 5) as stream,
    ):
        stream.sendall(json.dumps({"id": 1, "path": [POSE] * 3}).encode() + b"\n")
        assert begun.wait(5)
        server.stop()
        stream.settimeout(0.3)
        with pytest.raises(TimeoutError):
            stream.recv(1)
        server.stop()
        stream.settimeout(5)
        assert stream.recv(1) == b""
    go_on.set()


def test_a_damaged_folder_is_reported_and_the_others_are_served(kiro4, tmp_path):
    for name in ("damaged", "sound", "torn"):
        shutil.copytree(kiro4, tmp_path / name)
    (tmp_path / "damaged" / "model.safetensors").write_bytes(b"no weights")
    (tmp_path / "torn" / "model.yaml").unlink()
    models = ServedModels(model_folders(tmp_path), within=tmp_path)
    assert [model.name for model in map(models.__getitem__, range(len(models)))] == ["sound"]
    assert [name in problem for name, problem in zip(("damaged", "torn"), models.problems, strict=True)] == [
        True
    ] * 2
    assert len(models.reload()) == 2
    shutil.rmtree(tmp_path / "sound")
    with pytest.raises(ModelError, match=re.escape(str(tmp_path / "damaged"))):
        ServedModels(model_folders(tmp_path), within=tmp_path)


def test_a_folder_without_models_is_refused(tmp_path):
    with refused(ModelError, file=str(tmp_path)):
        model_folders(tmp_path)


def test_a_defect_is_reported_and_the_server_continues(served, monkeypatch):
    def broken(*arguments):
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(json_lines, "_solve", broken)
    with json_client(served) as client, no_type_checker():
        with pytest.raises(RuntimeError, match="ZeroDivisionError: oh"):
            client.ask(pose=POSE, model=0)
        assert client.ask(ask="health")["connections"] > 0


def test_coupled_joints_are_answered_in_the_values_of_the_controller(tmp_path):
    robot = coupled_robot()
    model = CalibratedModel(
        name="coupled",
        kind="geometric",
        robot=robot,
        calibrated=robot,
        network=None,
        domain=None,
        branches=(),
        starts=torch.full((1, 6), 0.3, dtype=torch.float64),
    )
    save_model(model, tmp_path)
    q = [10.0, -20.0, 30.0, 10.0, 35.0, -15.0]
    with running(tmp_path) as server, json_client(server) as lines, frame_client(server) as frames:
        pose = lines.ask(q_deg=q)["pose"]
        assert_close(lines.ask(pose=pose, near_deg=q)["q_deg"], q, atol=1e-7)
        T = pisigma.load(tmp_path).forward(np.radians(q))
        assert_close(np.degrees(frames.solve(T.ravel(), np.radians(q))[1]), q, atol=1e-9)
        (record,) = lines.ask(ask="models")["models"]
        assert record["limits"][1] == [-60.0, 76.0]
