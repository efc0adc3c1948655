"""The clients of the documentation are run if their language is available here, else parsed."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from lxml import etree
from scipy.spatial.transform import Rotation
from testing.closeness import assert_close
from testing.controller_clients import LANGUAGES, parse, run_urscript
from testing.serving import CLIENTS, client, json_client, running

import pisigma
from pisigma.deployment.serve.opcua import NAMESPACE
from pisigma.deployment.serve.settings import ServeSettings
from pisigma.robot.kernels.array_kinematics import transform_of

POSE = [800.0, 200.0, 600.0, 12.0, -80.0, 170.0]
NEAR = [0.26, 0.06, -0.03, -1.5, 0.35, 1.6]
PROGRAM = r"""
#include <stdlib.h>
#include "pisigma_client.h"
int main(int count, char **words) {
    double numbers[22], q[6];
    int server = pisigma_connect("127.0.0.1", atoi(words[1]));
    if (server < 0 || (count > 2 && pisigma_admit(server, words[2]) != 0)) return 3;
    for (;;) {
        for (int i = 0; i < 22; i++) if (scanf("%lf", &numbers[i]) != 1) return 0;
        printf("%d", pisigma_ask(server, 0, numbers, numbers + 16, 6, q));
        for (int i = 0; i < 6; i++) printf(" %.17g", q[i]);
        printf("\n");
    }
}
"""


@pytest.fixture(scope="module")
def ik(repository):
    return pisigma.load(repository / "models" / "kiro4")


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on the path")
def test_the_c_client_has_the_numbers_of_python(ik, repository, tmp_path):
    (tmp_path / "client.c").write_text(PROGRAM)
    options = ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-I", CLIENTS, "-o", tmp_path / "client"]
    subprocess.run(["gcc", *options, tmp_path / "client.c", "-lm"], check=True)
    starts = ik.model.starts[:50].double().numpy()
    T = np.asarray(ik.forward(starts))
    T[7, 0, 3] = 9.0
    rows = np.concatenate([T.reshape(-1, 16), starts], 1)
    text = "\n".join(" ".join(map(repr, row)) for row in rows.tolist())
    with running(repository / "models" / "kiro4", settings=ServeSettings(token="secret")) as server:
        command = [tmp_path / "client", str(server.binary_port)]
        done = subprocess.run([*command, "secret"], input=text, capture_output=True, text=True, check=True)
        assert subprocess.run([*command, "wrong"], input=text, text=True, check=False).returncode == 3
    answers = [[float(word) for word in line.split()] for line in done.stdout.splitlines()]
    assert len(answers) == len(T)
    for pose, near, (status, *q) in zip(T, starts, answers, strict=True):
        solution = ik(pose, near=near)
        assert status == solution.status
        np.testing.assert_array_equal(q, solution.q)


def test_urscript_gets_joint_values(ik, repository):
    """UR rotates about z, y and x like pisigma, but calls the angle about x roll."""
    x, y, z, roll, pitch, yaw = POSE
    turned = Rotation.from_euler("ZYX", [roll, pitch, yaw], degrees=True).as_rotvec().tolist()
    wanted = ik(transform_of([x / 1e3, y / 1e3, z / 1e3, *np.radians(POSE[3:])]), near=NEAR).q
    known = run_urscript((CLIENTS / "pisigma_client.script").read_text(), NEAR)
    with running(repository / "models" / "kiro4") as server:
        assert known["pisigma_connect"]("127.0.0.1", server.json_port)
        for number in range(3):
            q = known["pisigma_joints"]([x / 1e3, y / 1e3, z / 1e3, *turned], number)
            assert_close(q, wanted, atol=1e-7)
        assert known["pisigma_joints"]([9.0, 0.0, 0.0, *turned], 4) == [0]
        known["socket_close"]("pisigma")
    assert known["pisigma_read_joints"]('{"id": 1, "q_deg": [1, 2, 3, 4, 5, 6], "status": "reached"}', 2) == [
        0
    ]


@pytest.mark.parametrize("name", LANGUAGES)
def test_the_programs_of_controllers_parse(name):
    text = (CLIENTS / name).read_text()
    assert parse(name, text) > 25
    assert "not tested" in " ".join(text.split())
    for broken in (text.replace("THEN", "", 1), text + "\n?\n", text[: 4 * len(text) // 5]):
        with pytest.raises(ValueError, match=name):
            parse(name, broken)


@pytest.mark.parametrize("name", ["pisigma_client.src", "pisigma_client.mod", "pisigma_client.kl"])
def test_the_lines_that_they_send_are_requests(name, served):
    """The texts of a request, with numbers in place of variables."""
    text = (CLIENTS / name).read_text()
    for pattern in (r"SWRITE\(.*?\"(.*)\"", r"Str:=(.*);", r"WRITE link \((.*)\)"):
        if sent := re.findall(pattern, text):
            words = "".join(sent)
            break
    if name.endswith(".src"):
        line = re.sub(r"%\.\df|%d", "1", re.sub(r"(?<![\]}])%s", '"', words)).removesuffix("%s")
    else:
        quoted = r'"((?:[^"]|"")*)"' if name.endswith(".mod") else "'([^']*)'"
        line = re.sub(r"(?<=[\[,:] )(?=[,\]])", "1", "".join(re.findall(quoted, words)))
        line = line.replace('""', '"').replace("\\0A", "").replace(": , ", ": 1, ").replace("[, ", "[1, ")
    request = json.loads(line)
    with json_client(served) as lines:
        request.pop("id")
        request["pose"] = POSE if len(request["pose"]) == 6 else request["pose"]
        assert set(lines.ask(**request, model="kiro4")) == {"id", "q_deg", "status", "sha256"}


def test_the_channel_of_ethernetkrl_is_that_of_its_program():
    tree = etree.parse(str(CLIENTS / "pisigma_client.xml")).getroot()
    assert tree.findtext("CONFIGURATION/EXTERNAL/TYPE") == "Server"
    (element,) = tree.iterfind("RECEIVE/RAW/ELEMENT")
    program = (CLIENTS / "pisigma_client.src").read_text()
    assert f'EKI_GetString("pisigma", "{element.get("Tag")}"' in program
    assert element.get("EOS") == "10"
    for flag in (element.get("Set_Flag"), tree.find("CONFIGURATION/INTERNAL/ALIVE").get("Set_Flag")):
        assert f"WAIT FOR $FLAG[{flag}]" in program


def test_the_client_for_opc_ua_names_the_nodes_of_the_server():
    text = (CLIENTS / "pisigma_opcua.st").read_text()
    for name in (NAMESPACE, "Model0", "Model0.CorrectedJoints"):
        assert f"'{name}'" in text


def test_the_structures_of_structured_text_are_the_frames():
    text = (CLIENTS / "pisigma_client.st").read_text()
    sizes = {"BYTE": 1, "UDINT": 4, "ULINT": 8, "LREAL": 8}
    for name, wanted in (("PisigmaRequest", client.REQUEST.size), ("PisigmaAnswer", client.ANSWER.size)):
        body = text.split(f"TYPE {name} :")[1].split("END_STRUCT")[0]
        fields = re.findall(r": (?:ARRAY\[0\.\.(\d+)\] OF )?(BYTE|UDINT|ULINT|LREAL)", body)
        assert sum((int(last or 0) + 1) * sizes[kind] for last, kind in fields) == wanted
