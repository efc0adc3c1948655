"""Model folders are written whole or not at all."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from testing.models import hand_made_model

from pisigma.errors import OutputError
from pisigma.files import output_folder as staging
from pisigma.files.output_folder import check_replaceable, staged_folder
from pisigma.model.folder.model_folder import load_model, save_model


def write(folder: Path, name: str = "kiro3") -> None:
    with staged_folder(folder) as scratch:
        save_model(hand_made_model(name), scratch)


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_a_folder_and_its_parents_are_made(tmp_path):
    write(tmp_path / "a" / "b" / "model")
    assert names(tmp_path / "a" / "b") == ["model"]
    assert load_model(tmp_path / "a" / "b" / "model").robot.name == "kiro3"


def test_a_model_is_replaced_and_nothing_is_left_behind(tmp_path):
    write(tmp_path / "model")
    (tmp_path / "model" / "stale.png").write_text("old")
    write(tmp_path / "model", "kiro4")
    assert names(tmp_path) == ["model"]
    assert names(tmp_path / "model") == ["compiled.npz", "model.safetensors", "model.yaml"]
    assert load_model(tmp_path / "model").robot.name == "kiro4"


def test_an_empty_folder_is_taken(tmp_path):
    (tmp_path / "model").mkdir()
    write(tmp_path / "model")
    assert load_model(tmp_path / "model").robot.name == "kiro3"


def test_a_linked_folder_stays_linked(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write(tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert load_model(tmp_path / "real").robot.name == "kiro3"


@pytest.mark.parametrize("before", [None, "kiro3"])
@pytest.mark.parametrize("end", [KeyboardInterrupt, RuntimeError])
def test_an_interruption_leaves_what_was_there(tmp_path, before, end):
    if before:
        write(tmp_path / "model", before)

    def interrupted() -> None:
        with staged_folder(tmp_path / "model") as scratch:
            save_model(hand_made_model("kiro4"), scratch)
            raise end

    with pytest.raises(end):
        interrupted()
    assert names(tmp_path) == (["model"] if before else [])
    if before:
        assert load_model(tmp_path / "model").robot.name == before


def test_a_failing_rename_brings_the_old_model_back(tmp_path, monkeypatch):
    write(tmp_path / "model")
    rename = os.replace

    def failing(source, target):
        if Path(source).suffix == ".partial":
            raise OSError(28, "No space left on device")
        rename(source, target)

    monkeypatch.setattr(staging.os, "replace", failing)
    with pytest.raises(OutputError, match=r"model: cannot be written \(No space left on device\)"):
        write(tmp_path / "model", "kiro4")
    assert names(tmp_path) == ["model"]
    assert load_model(tmp_path / "model").robot.name == "kiro3"


@pytest.mark.parametrize("before", [None, "kiro3"])
def test_a_killed_process_leaves_what_was_there(tmp_path, before):
    """SIGKILL when all but the last rename is done."""
    if before:
        write(tmp_path / "model", before)
    script = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from pisigma.files.output_folder import staged_folder\n"
        "with staged_folder(sys.argv[1]) as scratch:\n"
        "    (scratch / 'model.yaml').write_text('format: 1')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path / "model")], check=False)
    assert done.returncode == -signal.SIGKILL
    assert (tmp_path / "model").exists() == bool(before)
    write(tmp_path / "model", "kiro4")
    assert load_model(tmp_path / "model").robot.name == "kiro4"


def test_what_is_no_model_is_not_touched(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("mine")
    for name in ("file", "folder"):
        with pytest.raises(OutputError, match=f"{name}: exists and is no model folder; choose another --out"):
            write(tmp_path / name)
    assert (tmp_path / "folder" / "thesis.txt").read_text() == (tmp_path / "file").read_text() == "mine"


def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match=r"model: cannot be written \(.+\); choose another --out"):
        check_replaceable(tmp_path / "file" / "model")
    check_replaceable(tmp_path / "new" / "model")
    assert names(tmp_path) == ["file"]
