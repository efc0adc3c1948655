"""A server of a cell takes over the model in use between two requests, with all protocols."""

import json
from xml.etree import ElementTree

import pytest
from testing.cell_models import FIRST, SECOND, cell_of_two_models, put_into_use
from testing.serving import frame_client, json_client, running

from pisigma.deployment.serve.json_lines import JsonLines
from pisigma.deployment.serve.metrics import Metrics
from pisigma.deployment.serve.models import ServedModels
from pisigma.deployment.serve.settings import ServeSettings
from pisigma.files.model_files import model_hash

POSE = [800.0, 200.0, 600.0, 10.0, -80.0, 170.0]


@pytest.fixture
def cell(tmp_path):
    return cell_of_two_models(tmp_path / "cell")


def test_every_protocol_names_the_model_that_answers(cell):
    zmq = pytest.importorskip("zmq")
    hashes = {name: model_hash(cell.folder / "models" / name)[:16] for name in (FIRST, SECOND)}
    with (
        running(cell=cell.folder, settings=ServeSettings(zmq_port=0)) as server,
        json_client(server) as lines,
        frame_client(server) as frames,
        zmq.Context() as context,
        context.socket(zmq.REQ) as socket,
    ):
        socket.connect(f"tcp://127.0.0.1:{server.zmq.port}")
        for name in (FIRST, SECOND):
            put_into_use(cell, name)
            assert lines.ask(ask="reload") == {"id": lines._id, "problems": [], "models": 1}
            assert lines.ask(pose=POSE)["model"] == lines.ask(path=[POSE, POSE])["model"] == name
            assert lines.ask(pose=POSE, brief=True)["sha256"] == hashes[name]
            joints = len(lines.ask(ask="models")["models"][0]["joints"])
            q = {"q_deg" if name == FIRST else "q": [10.0] * joints}
            assert lines.ask(**q)["model"] == name
            frames.solve([1.0] * 16)
            assert frames.sha256 == hashes[name]
            socket.send(json.dumps({"pose": POSE, "model": name}).encode())
            assert json.loads(socket.recv())["model"] == name


def test_a_client_learns_the_state_of_the_model_and_its_urdf(cell):
    models = ServedModels(cell=cell.folder)
    protocol = JsonLines(models, Metrics())

    def ask(question):
        return json.loads(protocol.answer_message(json.dumps({"ask": question}).encode())())

    status, step = ask("status"), cell.status().step
    assert (status["model"], status["day"], status["state"]) == (FIRST, "2026-01-10", step.state)
    assert status["sha256"] == ask("urdf")["sha256"] == model_hash(cell.folder / "models" / FIRST)
    assert ElementTree.fromstring(ask("urdf")["urdf"]).get("name") == FIRST
    put_into_use(cell, SECOND)
    assert ask("status")["state"] == "not_in_use"
    models.reload()
    assert ask("status")["state"] == cell.status().step.state
    with (cell.folder / "models" / SECOND / "model.yaml").open("a") as file:
        file.write("# edited\n")
    assert "error" in ask("urdf")


def test_a_path_that_was_begun_is_answered_by_one_model(cell):
    models = ServedModels(cell=cell.folder)
    protocol = JsonLines(models, Metrics())
    begun = protocol.answer_message(json.dumps({"path": [POSE] * 3}).encode())
    put_into_use(cell, SECOND)
    assert models.reload() == []
    answers = [
        json.loads(one()) for one in (begun, protocol.answer_message(json.dumps({"path": [POSE]}).encode()))
    ]
    assert [one["model"] for one in answers] == [FIRST, SECOND]
    assert len(answers[0]["q_deg"]) == 3


def test_a_damaged_model_leaves_the_one_before_and_is_reported(cell):
    models, reports = ServedModels(cell=cell.folder), []
    (cell.folder / "models" / SECOND / "model.yaml").write_text("damaged")
    with models.follow_changes(reports.append):
        put_into_use(cell, SECOND)
        (problem,) = models.reload()
        assert SECOND in problem
    assert models.find_model(None).name == FIRST
