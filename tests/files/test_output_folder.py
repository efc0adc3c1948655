"""Model folders are written completely or not at all."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from testing.models import hand_made_model
from testing.refusals import refused

from pisigma.files.errors import OutputError
from pisigma.files.output_folder import check_folder, staged_folder
from pisigma.model.folder.model_folder import load_model, save_model


def write(folder: Path, name: str = "kiro3") -> None:
    with staged_folder(folder, overwrite=True) as scratch:
        save_model(hand_made_model(name), scratch)


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_a_folder_and_its_parents_are_created(tmp_path):
    write(tmp_path / "a" / "b" / "model")
    assert names(tmp_path / "a" / "b") == ["model"]
    assert load_model(tmp_path / "a" / "b" / "model").robot.name == "kiro3"


def test_a_model_is_replaced_without_leftover_files(tmp_path):
    write(tmp_path / "model")
    (tmp_path / "model" / "residuals.png").write_text("old")
    write(tmp_path / "model", "kiro4")
    assert names(tmp_path) == ["model"]
    assert names(tmp_path / "model") == ["compiled.npz", "model.safetensors", "model.yaml"]
    assert load_model(tmp_path / "model").robot.name == "kiro4"


def test_an_empty_folder_is_used(tmp_path):
    (tmp_path / "model").mkdir()
    write(tmp_path / "model")
    assert load_model(tmp_path / "model").robot.name == "kiro3"


def test_a_linked_folder_remains_linked(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write(tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert load_model(tmp_path / "real").robot.name == "kiro3"


@pytest.mark.parametrize("before", [None, "kiro3"])
@pytest.mark.parametrize("end", [KeyboardInterrupt, RuntimeError])
def test_an_interruption_leaves_the_folder_as_it_was(tmp_path, before, end):
    if before:
        write(tmp_path / "model", before)

    def interrupted() -> None:
        with staged_folder(tmp_path / "model", overwrite=True) as scratch:
            save_model(hand_made_model("kiro4"), scratch)
            raise end

    with pytest.raises(end):
        interrupted()
    assert names(tmp_path) == (["model"] if before else [])
    if before:
        assert load_model(tmp_path / "model").robot.name == before


def test_a_failing_rename_restores_the_old_model(tmp_path, monkeypatch):
    write(tmp_path / "model")
    rename = os.replace

    def failing(source, target):
        if Path(source).suffix == ".partial":
            raise OSError(28, "No space left on device")
        rename(source, target)

    monkeypatch.setattr(os, "replace", failing)
    with refused(OutputError, file="model", value="No space left on device"):
        write(tmp_path / "model", "kiro4")
    assert names(tmp_path) == ["model"]
    assert load_model(tmp_path / "model").robot.name == "kiro3"


@pytest.mark.parametrize("before", [None, "kiro3"])
def test_a_killed_process_leaves_the_folder_as_it_was(tmp_path, before):
    """Killed just before the last rename."""
    if before:
        write(tmp_path / "model", before)
    script = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from pisigma.files.output_folder import staged_folder\n"
        "with staged_folder(sys.argv[1], overwrite=True) as scratch:\n"
        "    (scratch / 'model.yaml').write_text('format: 1')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path / "model")], check=False)
    assert done.returncode == -signal.SIGKILL
    assert (tmp_path / "model").exists() == bool(before)
    assert any(name.endswith(".partial") for name in names(tmp_path))
    write(tmp_path / "model", "kiro4")
    assert load_model(tmp_path / "model").robot.name == "kiro4"
    assert names(tmp_path) == ["model"]


def test_files_and_other_folders_are_not_touched(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("mine")
    for name in ("file", "folder"):
        with refused(OutputError, file=tmp_path / name, expected="a model folder"):
            write(tmp_path / name)
    assert (tmp_path / "folder" / "thesis.txt").read_text() == (tmp_path / "file").read_text() == "mine"


def test_a_path_that_cannot_be_written_is_rejected_before_the_work(tmp_path):
    (tmp_path / "file").write_text("mine")
    with refused(OutputError, file=tmp_path / "file" / "model", value="Not a directory"):
        check_folder(tmp_path / "file" / "model", overwrite=False)
    check_folder(tmp_path / "new" / "model", overwrite=False)
    assert names(tmp_path) == ["file"]


def test_a_model_is_replaced_on_request_only(tmp_path):
    write(tmp_path / "model")
    before = (tmp_path / "model" / "model.yaml").read_bytes()
    with refused(OutputError, file="model", expected="a new or empty folder"):
        check_folder(tmp_path / "model", overwrite=False)
    assert (tmp_path / "model" / "model.yaml").read_bytes() == before


@pytest.mark.parametrize("other", ["notes.txt", ".git", "data.csv", "photo.png"])
def test_a_model_folder_with_other_files_is_not_replaced(tmp_path, other):
    write(tmp_path / "model")
    (tmp_path / "model" / other).mkdir()
    with refused(OutputError, file="model", value=other):
        write(tmp_path / "model")
    assert (tmp_path / "model" / other).is_dir()


def test_a_card_alone_is_not_a_model(tmp_path):
    """As in another project, which may even have a file `model.yaml`."""
    for name in ("README.md", "model.yaml"):
        (tmp_path / name).write_text("layers: 4\n")
        with refused(OutputError, file=tmp_path, expected="a model folder"):
            check_folder(tmp_path, overwrite=True)


def test_the_working_directory_is_rejected(tmp_path, monkeypatch):
    (tmp_path / "project" / "work").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "project" / "work")
    for folder in (".", "..", tmp_path / "project", "/"):
        with refused(OutputError, file=folder, value=str(tmp_path / "project" / "work")):
            check_folder(folder, overwrite=True)


def test_a_folder_in_conflict_with_an_input_is_rejected(tmp_path):
    write(tmp_path / "model")
    data = tmp_path / "model" / "held_out.csv"
    data.write_text("q1_deg")
    (tmp_path / "link").symlink_to(tmp_path / "model")
    for folder, source, expected in (
        ("model", "model", "a path that is not an input"),
        ("link", "model", "a path that is not an input"),
        ("model", "model/held_out.csv", "a folder without inputs"),
        ("model/new", "link", "a path outside the inputs"),
        ("link/new", "missing.csv", "a path outside model folders"),
    ):
        value = str(tmp_path / ("model" if source == "missing.csv" else source))
        with refused(OutputError, file=tmp_path / folder, expected=expected, value=value):
            check_folder(tmp_path / folder, overwrite=True, inputs=(None, tmp_path / source))
    assert data.read_text() == "q1_deg"


def killed_between_renames(folder: Path) -> None:
    script = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from pisigma.files.output_folder import staged_folder\n"
        "rename = os.replace\n"
        "def once(source, target):\n"
        "    rename(source, target)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
        "os.replace = once\n"
        "with staged_folder(sys.argv[1], overwrite=True) as scratch:\n"
        "    (scratch / 'model.yaml').write_text('format: 1')\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(folder)], check=False)
    assert done.returncode == -signal.SIGKILL


def test_a_model_that_a_killed_process_moved_away_is_restored(tmp_path):
    write(tmp_path / "model")
    killed_between_renames(tmp_path / "model")
    assert not (tmp_path / "model").exists()
    assert {Path(name).suffix for name in names(tmp_path)} == {".old", ".partial"}
    with refused(OutputError, file="model", expected="a new or empty folder"):
        check_folder(tmp_path / "model", overwrite=False)
    assert names(tmp_path) == ["model"]
    assert load_model(tmp_path / "model").robot.name == "kiro3"


def test_scratch_of_a_living_process_is_not_removed(tmp_path):
    with staged_folder(tmp_path / "model") as scratch:
        write(tmp_path / "model")
        assert scratch.is_dir()
        (tmp_path / "model" / "model.yaml").unlink()
        (tmp_path / "model" / "model.safetensors").unlink()
        (tmp_path / "model" / "compiled.npz").unlink()
        save_model(hand_made_model("kiro4"), scratch)
    assert load_model(tmp_path / "model").robot.name == "kiro4"


def test_only_scratch_of_pisigma_is_removed(tmp_path):
    others = {
        ".model.partial",
        ".model.a.b.partial",
        ".other.abc.partial",
        ".model.backup.old",
        ".model.abc.txt",
    }
    for name in others:
        (tmp_path / name).mkdir()
    (tmp_path / ".model.abcdefgh.partial").mkdir()
    (tmp_path / ".model.abcdefgh.part").write_text("")
    write(tmp_path / "model")
    assert set(names(tmp_path)) == {"model", *others}


def test_a_file_that_could_not_be_replaced_later_is_a_defect(tmp_path):
    with (
        pytest.raises(AssertionError, match=r"plan.csv.* could not be replaced later"),
        staged_folder(tmp_path / "m") as scratch,
    ):
        (scratch / "plan.csv").write_text("")


def test_a_file_added_meanwhile_is_not_replaced(tmp_path):
    write(tmp_path / "model")

    def disturbed() -> None:
        with staged_folder(tmp_path / "model", overwrite=True) as scratch:
            save_model(hand_made_model("kiro4"), scratch)
            (tmp_path / "model" / "notes.txt").write_text("mine")

    with refused(OutputError, file="model", value="notes.txt"):
        disturbed()
    assert (tmp_path / "model" / "notes.txt").read_text() == "mine"
    assert load_model(tmp_path / "model").robot.name == "kiro3"
    assert names(tmp_path) == ["model"]


def test_the_number_of_new_folders_is_limited(tmp_path):
    with refused(OutputError, expected="100 new folders or fewer", value=1_500):
        check_folder(tmp_path.joinpath(*["a"] * 1_500), overwrite=False)
    assert not list(tmp_path.iterdir())
