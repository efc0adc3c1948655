"""Lines of JSON have the numbers of Python, and an error for invalid requests."""

import json
import math
import socket
from contextlib import contextmanager

import numpy as np
import pytest
from testing.calibrated_arm import calibrated_arm, calibrated_robot
from testing.closeness import assert_close
from testing.models import with_limits
from testing.refusals import numbers_in
from testing.serving import json_client, running

import pisigma
from pisigma.deployment.serve import json_lines
from pisigma.files.errors import missing_extra
from pisigma.model.folder.model_folder import save_model
from pisigma.robot import Robot
from pisigma.robot.kernels.array_kinematics import transform_of, xyz_zyx_of

POSE = [800.0, 200.0, 600.0, 10.0, -80.0, 170.0]
NEAR = [15.0, 3.0, -1.0, -85.0, 19.0, 92.0]


@pytest.fixture(scope="module")
def ask(served):
    with json_client(served) as client:
        yield client.ask


@pytest.fixture(scope="module")
def ik(repository):
    return pisigma.load(repository / "models" / "kiro4")


@pytest.fixture
def raw(served):
    """Send bytes, and return the answer to each line."""

    def exchange(*lines):
        with socket.create_connection(("127.0.0.1", served.json_port), 5) as stream:
            stream.sendall(b"".join(lines))
            stream.shutdown(socket.SHUT_WR)
            with stream.makefile("rb") as file:
                return [json.loads(line) for line in file]

    return exchange


def _matrix(pose):
    return transform_of([*(value / 1e3 for value in pose[:3]), *map(math.radians, pose[3:])])


def test_a_pose_is_answered_with_the_numbers_of_python(ask, ik):
    answer = ask(pose=POSE, near_deg=NEAR, model="kiro4")
    solution = ik(_matrix(POSE), near=np.radians(NEAR))
    assert_close(answer["q_deg"], np.degrees(solution.q), rtol=1e-15)
    assert (answer["status"], answer["branch"]) == ("reached", ik.branches[int(solution.branch)])
    assert answer["position_residual_mm"] < 1e-9
    assert answer["rotation_residual_deg"] < 1e-9


def test_a_pose_that_is_not_reached_has_no_joint_values(ask):
    answer = ask(pose=[9000, *POSE[1:]], model=0)
    assert (answer["status"], answer["q_deg"]) == ("unreachable", None)
    assert "sentence" in answer


@pytest.mark.parametrize(
    "line",
    [
        b'{"id": 1e3, "pose": [1, -0.0, 5e-324, 0.1]}',
        b'{"id": "a:b", "pose": "\\ud800"}',
        b'{"id" : 1, "pose": {"id": [1]}}',
        b"12345678901234567890",
    ],
)
def test_lines_are_read_as_python_reads_them(line):
    assert json_lines._decode(line) == json.loads(line)


@pytest.mark.parametrize(
    "line", [b'{"id" : 1, "i\\u0064":2}', b'{"id": Infinity}', b'{"id": 01}', b"\xef\xbb\xbf{}", b"[" * 9999]
)
def test_invalid_json_is_refused_with_a_reason(line):
    with pytest.raises((ValueError, RecursionError)):
        json_lines._decode(line)


def test_forward_is_the_inverse_of_a_pose(ask):
    q = ask(pose=POSE, model="kiro4")["q_deg"]
    answer = ask(q_deg=q, model="kiro4", accuracy=True)
    assert_close(answer["pose"], POSE, atol=1e-6)
    assert "accuracy_mm" in answer


def test_a_path_equals_that_of_python(ask, ik):
    poses = [[*POSE[:2], 600.0 + 5 * step, *POSE[3:]] for step in range(20)]
    answer = ask(path=poses, near_deg=NEAR, model="kiro4")
    path = ik.path(np.stack([_matrix(pose) for pose in poses]), near=np.radians(NEAR))
    assert_close(answer["q_deg"], np.degrees(path.solution.q), rtol=1e-15)
    assert answer["status"] == ["reached"] * 20
    assert answer["switches"] == []


def test_ignored_axes_are_those_of_python(repository, tmp_path):
    model = calibrated_arm("ur10")
    save_model(model, tmp_path)
    ik = pisigma.load(tmp_path)
    T = np.asarray(ik.forward(np.array([0.3, -1.2, 1.4, -0.6, -1.2, 0.4])))
    x, y, z, *angles = xyz_zyx_of(T)
    pose = [x * 1e3, y * 1e3, z * 1e3, *np.degrees(angles)]
    near = np.array([0.2, -1.0, 1.2, -0.5, -1.0, 1.4])
    with running(tmp_path) as server, json_client(server) as client:
        asked = {"pose": pose, "near_deg": np.degrees(near).tolist()}
        answer = client.ask(**asked, ignore_axes=["yaw"])
        solution = ik(_matrix(pose), near=near, ignore_axes=["yaw"])
        assert answer["ignored_axes"] == ["yaw"]
        assert_close(answer["q_deg"], np.degrees(solution.q), atol=1e-9)
        answer = client.ask(**asked, tolerance_mm=0.5, tolerance_deg=[0, 0, 1])
        solution = ik(_matrix(pose), near=near, tolerance_mm=0.5, tolerance_deg=[0, 0, 1])
        assert_close(answer["q_deg"], np.degrees(solution.q), atol=1e-9)
        path = client.ask(path=[pose, pose], near_deg=np.degrees(near).tolist(), ignore_axes=["yaw"])
        assert path["status"] == ["reached"] * 2
        for wrong, named in (
            ({"ignore_axes": ["jaw"]}, "jaw.*yaw"),
            ({"ignore_axes": "yaw"}, "^ignore_axes: .*yaw"),
            ({"tolerance_mm": [1, 2]}, "^tolerance_mm: .* 3 .* 2"),
            ({"tolerance_deg": "1"}, "^tolerance_deg: .* '1'"),
            ({"tolerance_deg": -1}, "tolerance_deg.* -1|-1.* 0"),
            ({"elbow_deg": 10}, "^elbow_angle: "),
        ):
            with pytest.raises(RuntimeError, match=named):
                client.ask(**asked, **wrong)


def test_a_robot_with_a_prismatic_joint_uses_the_key_q(ask):
    (kiro3,) = (model for model in ask(ask="models")["models"] if model["name"] == "kiro3")
    units = kiro3["units"]
    assert set(units) == {"deg", "mm"}
    pose = ask(q=[10.0] * len(units), model="kiro3")["pose"]
    answer = ask(pose=pose, near=[10.0] * len(units), model="kiro3")
    assert_close(answer["q"], [10.0] * len(units), atol=1e-6)
    for request in ({"q_deg": [10.0] * len(units)}, {"pose": pose, "near_deg": [10.0] * len(units)}):
        with pytest.raises(RuntimeError, match=r"^(q|near)_deg: .*'kiro3'.*'(q|near)'"):
            ask(**request, model="kiro3")


def test_health_counts_answers(ask):
    before = ask(ask="health")
    ask(pose=POSE, model="kiro4")
    after = ask(ask="health")
    assert after["statuses"]["reached"] == before["statuses"].get("reached", 0) + 1
    assert 0 < after["p50_us"] <= after["p99_us"]
    assert after["connections"] >= 1


@pytest.mark.parametrize(
    ("request_", "named"),
    [
        ({"pose": POSE}, "^model: .*None"),
        ({"pose": POSE, "model": "kiro5"}, "^model: .*kiro5.*kiro4"),
        ({"pose": POSE, "model": True}, "^model: .*True"),
        ({"pose": POSE[:5], "model": 0}, "^pose: .* 6 .* 5[.]$"),
        ({"pose": [True, *POSE[1:]], "model": 0}, "^pose: .*'True'"),
        ({"pose": [1e300, *POSE[1:]], "model": 0}, "^pose: .*'1e.300'"),
        ({"pose": POSE, "model": 0, "near_deg": [90] * 5}, "^near_deg: .* 6 .* 5[.]$"),
        ({"pose": POSE, "model": 0, "near_deg": [9e4] * 6}, "^near_deg: .* deg[.]$"),
        ({"pose": POSE, "model": 0, "branch": "upside"}, "^branch: .*'upside'"),
        ({"pose": POSE, "model": 0, "braunch": "x"}, "^braunch: .*'branch'"),
        ({"pose": POSE, "q_deg": NEAR, "model": 0}, "pose, path, q_deg, q, ask.* 2[.]$"),
        ({"model": 0}, "pose, path, q_deg, q, ask.* 0[.]$"),
        ({"ask": "heath"}, "^ask: .*'heath'.*'health'"),
        ({"path": [], "model": 0}, "^path: "),
        ({"path": [POSE, 7], "model": 0}, r"^path\[1\]: .* 6 .*'7'"),
        ({"pose": POSE, "model": 0, "accuracy": 1}, "^accuracy: .*'1'"),
        ({"pose": POSE, "model": 0, "approach": [2] * 6}, "^approach: .* 2[.]$"),
    ],
)
def test_an_invalid_request_is_answered_with_the_key_at_fault(ask, request_, named):
    with pytest.raises(RuntimeError, match=named):
        ask(**request_)


def test_lines_that_are_not_requests_get_an_error_and_the_others_their_answers(raw):
    good = json.dumps({"id": "a", "pose": POSE, "model": 0}).encode() + b"\n"
    lines = [
        b"\n",
        b"[1]\n",
        b"\xff\xfe\n",
        b'{"id": {}}\n',
        b"[" * 100_000 + b"\n",
        b'{"id": 1, "pose": NaN}\n',
    ]
    lines.append(b'{"id": 2, "id": 3, "ask": "health"}\n')
    answers = raw(*(part for line in lines for part in (line, good)))
    assert len(answers) == 2 * len(lines)
    for refused, answered in zip(answers[::2], answers[1::2], strict=True):
        assert set(refused) == {"id", "error"}
        assert answered["id"] == "a"
        assert answered["status"] == "reached"


def test_an_incomplete_line_is_never_answered(raw):
    whole = json.dumps({"id": 1, "pose": POSE, "model": 0}).encode()
    assert raw(whole) == []
    assert raw(whole + b"\n", whole[:-30]) == raw(whole + b"\n")


def test_a_line_that_is_too_long_ends_the_connection(raw):
    (answer,) = raw(b" " * (2**20 + 1))
    assert numbers_in(answer["error"]) == [2**20]


@contextmanager
def _lines_of(server):
    with (
        socket.create_connection(("127.0.0.1", server.json_port), 5) as stream,
        stream.makefile("rwb") as file,
    ):

        def exchange(request):
            file.write(json.dumps(request).encode() + b"\n")
            file.flush()
            return json.loads(file.readline())

        yield exchange


def test_joints_without_limits_have_null(tmp_path):
    robot = with_limits(Robot.load("kiro4"), 5, -math.inf, math.inf)
    folder = tmp_path / "open"
    folder.mkdir()
    save_model(calibrated_robot(robot, hybrid=False), folder)
    with running(folder) as server, json_client(server) as client:
        (model,) = client.ask(ask="models")["models"]
    assert model["limits"][5] == [None, None]
    assert_close(model["limits"][:5], np.degrees(robot.limits[:5]), atol=1e-9)


def test_the_example_of_the_documentation_is_answered_as_documented(repository):
    page = (repository / "docs" / "reference" / "serve-protocol.md").read_text()
    lines = [json.loads(line) for line in page.split("```text\n")[1].split("```")[0].splitlines()]
    with running(repository / "models" / "kiro4") as server, _lines_of(server) as exchange:
        for request, documented in zip(lines[::2], lines[1::2], strict=True):
            answer = exchange(request)
            assert answer.keys() == documented.keys()
            for key, value in documented.items():
                if key in ("uptime_s", "p50_us", "p99_us"):
                    assert answer[key] > 0
                elif isinstance(value, float | list):
                    assert_close(answer[key], value, atol=5e-5)
                else:
                    assert answer[key] == value


def test_a_package_that_is_not_installed_is_no_defect(ask, monkeypatch):
    problem = ModuleNotFoundError(name="torch")

    def forward(*_):
        raise problem

    monkeypatch.setattr(json_lines, "_forward", forward)
    with pytest.raises(RuntimeError) as refusal:
        ask(q_deg=NEAR, model="kiro4")
    assert str(refusal.value) == str(missing_extra(problem))
