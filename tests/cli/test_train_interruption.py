"""A killed training resumes to the same model; Ctrl-C leaves nothing half written."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from testing.closeness import assert_close

from pisigma.workflow.recipes.data import load_data
from pisigma.workflow.recipes.reader import read_recipe
from pisigma.workflow.settings.training import TrainSettings
from pisigma.workflow.train import train_networks

# Slow enough to be caught in the middle: every epoch waits, the last ones for long, which changes no number.
SLOW = """
import sys, time
from pisigma.network.networks import NetworkTraining
step = NetworkTraining.training_step
def slow(self, batch, batch_idx):
    time.sleep(WAIT if int(self.epochs_done) < 40 else 100 * WAIT)
    return step(self, batch, batch_idx)
WAIT = float(sys.argv.pop(1))
NetworkTraining.training_step = slow
from pisigma.cli.main import run
run()
"""
EPOCHS = 60
PAPER = ("kiro3_paper", ("epochs: 3000", f"epochs: {EPOCHS}"))
DEFAULT = (
    "kiro3",
    ("epochs: 300", f"epochs: {EPOCHS}"),
    ("starts: 6", "starts: 2"),
    ("count: 2000", "count: 10"),
)


def command(wait: float, *arguments: str) -> list[str]:
    return [sys.executable, "-c", SLOW, str(wait), *arguments]


def environment() -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": "1"}


def heed_ctrl_c() -> None:
    """Undo what a shell does to processes in the background, these tests among them: they ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def start_and_wait_for_a_checkpoint(cwd: Path, recipe: Path) -> subprocess.Popen[bytes]:
    process = subprocess.Popen(
        command(0.02, "train", str(recipe), "--out", "model"),
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment(),
        preexec_fn=heed_ctrl_c,
    )
    checkpoint = cwd / ".model.training" / "last.ckpt"
    for _ in range(2400):
        if checkpoint.is_file() or process.poll() is not None:
            break
        time.sleep(0.05)
    assert process.poll() is None, process.communicate()[1].decode()
    assert checkpoint.is_file()
    return process


def kill_after_a_checkpoint(folder: Path, recipe: Path) -> None:
    folder.mkdir()
    process = start_and_wait_for_a_checkpoint(folder, recipe)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert [entry.name for entry in folder.iterdir()] == [".model.training"]


def test_ctrl_c_leaves_only_the_checkpoints_and_resumes_to_the_same_model_folder(run, write_recipe, tmp_path):
    recipe = write_recipe(*PAPER)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    broken.mkdir()
    process = start_and_wait_for_a_checkpoint(broken, recipe)
    process.send_signal(signal.SIGINT)
    output, complaint = process.communicate()
    assert process.returncode == 130, complaint.decode()
    assert output == b""
    assert b"Traceback" not in complaint
    assert [entry.name for entry in broken.iterdir()] == [".model.training"]

    for folder, options in ((whole, ()), (broken, ("--resume",))):
        result = run("train", recipe, "--out", folder / "model", "--json", *options)
        assert result.exit_code == 0, result.output
        assert json.loads(result.stdout)["model"] == str(folder / "model")
        assert [entry.name for entry in folder.iterdir()] == ["model"]  # no lightning_logs, no checkpoints
    for name in ("model.safetensors", "energy.csv"):
        assert (broken / "model" / name).read_bytes() == (whole / "model" / name).read_bytes()


def test_killed_and_resumed_levenberg_marquardt_gives_the_same_weights(write_recipe, tmp_path):
    path = write_recipe(*DEFAULT)
    recipe = read_recipe(path)
    kill_after_a_checkpoint(tmp_path / "broken", path)
    options = TrainSettings(tmp_path / "broken" / ".model.training", resume=True)
    resumed = train_networks(recipe, load_data(recipe), options)
    whole = train_networks(recipe, load_data(recipe))
    assert 0 < resumed.history.resumed_from < EPOCHS
    assert_close(resumed.history.energies, whole.history.energies, atol=0)
    for name, value in whole.model.network.state_dict().items():
        assert_close(resumed.model.network.state_dict()[name], value, atol=0)
