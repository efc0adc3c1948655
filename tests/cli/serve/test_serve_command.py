"""`pisigma serve` as a process: the line that says it is ready, signals, and what it refuses."""

import json
import signal
import subprocess
import sys

from testing.serving import client

from pisigma.files.errors import ModelError, OutputError

POSE = [800.0, 200.0, 600.0, 10.0, -80.0, 170.0]


def test_the_server_prints_its_ports_answers_and_ends_at_sigterm(repository):
    command = [sys.executable, "-m", "pisigma", "serve", "--models", str(repository / "models")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        ports = json.loads(process.stdout.readline())
        assert set(ports) == {"json_port", "binary_port"}
        lines = client.JsonClient(ports["json_port"])
        folders = sorted(path.name for path in (repository / "models").iterdir() if path.is_dir())
        assert [model["name"] for model in lines.ask(ask="models")["models"]] == folders
        process.send_signal(signal.SIGHUP)
        assert lines.ask(pose=POSE, model="kiro4")["status"] == "reached"
        process.send_signal(signal.SIGTERM)
        lines.close()
        out, warnings = process.communicate(timeout=10)
        assert (out, warnings.count("\n")) == ("", 1)
        assert warnings.startswith("fanuc_burakov")  # its poses are those of the first of several targets
    assert process.returncode == 0


def test_what_cannot_be_served_is_refused(refuses, run, repository, tmp_path):
    model = repository / "models" / "kiro4"
    refuses("serve", tmp_path / "none", error=ModelError)
    refuses("serve", "--models", tmp_path, error=ModelError)
    refuses("serve", model, "--host", "0.0.0.0", error=OutputError)
    (tmp_path / "token").write_text("\n")
    refuses("serve", model, "--token-file", tmp_path / "token", error=OutputError)
    assert run("serve").exit_code == run("serve", model, "--models", tmp_path).exit_code == 2
