"""Output files are written completely or not at all."""

import os

from testing.refusals import refused

from pisigma.files.errors import OutputError
from pisigma.files.output_file import check_output, write_atomically


def test_a_file_is_replaced_completely(tmp_path):
    path = tmp_path / "out.csv"
    path.write_text("old")
    check_output(path, (".csv",), "a table")
    write_atomically(path, "new\n")
    assert path.read_bytes() == b"new\n"
    assert path.stat().st_mode & 0o777 == 0o644
    assert list(tmp_path.iterdir()) == [path]


def test_no_files_remain_if_the_rename_fails(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    (tmp_path / "out.csv").write_text("old")
    monkeypatch.setattr(os, "replace", fail)
    with refused(OutputError, file="out.csv", value="No space left on device"):
        write_atomically(tmp_path / "out.csv", "new")
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("out.csv", "old")]


def test_paths_that_cannot_be_written_are_rejected(tmp_path):
    (tmp_path / "folder.csv").mkdir()
    for path, value in (
        (tmp_path / "out.txt", ".txt"),
        (tmp_path / "folder.csv", "a folder"),
        (tmp_path / "none" / "out.csv", str(tmp_path / "none")),
    ):
        with refused(OutputError, file=path, value=value):
            check_output(path, (".csv", ".yaml"), "a table")
    with refused(OutputError, file="out.csv", value=str(tmp_path / "none")):
        write_atomically(tmp_path / "none" / "out.csv", "text")


def test_an_input_is_never_overwritten(tmp_path):
    source = tmp_path / "in.csv"
    source.write_text("mine")
    (tmp_path / "soft.csv").symlink_to(source)
    os.link(source, tmp_path / "hard.csv")
    for name in ("in.csv", "soft.csv", "hard.csv", "../" + tmp_path.name + "/in.csv"):
        with refused(OutputError, file=tmp_path / name, value=str(source)):
            check_output(tmp_path / name, inputs=("no robot", source))
    (tmp_path / "folder").mkdir()
    with refused(OutputError, file="out.csv", value=str(tmp_path / "folder")):
        check_output(tmp_path / "folder" / "out.csv", inputs=(tmp_path / "folder",))
    assert source.read_text() == "mine"


def test_a_part_of_a_model_is_never_overwritten(tmp_path):
    (tmp_path / "model.yaml").write_text("format: 4\n")
    (tmp_path / "sub").mkdir()
    for path in (tmp_path / "model.yaml", tmp_path / "sub" / "new.csv"):
        with refused(OutputError, file=path, value=str(tmp_path)):
            write_atomically(path, "text")
    assert (tmp_path / "model.yaml").read_text() == "format: 4\n"


def test_a_pipe_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with refused(OutputError, file="pipe.csv", value="a device or a pipe"):
        write_atomically(tmp_path / "pipe.csv", "text")


def test_a_linked_file_remains_linked_and_files_of_killed_processes_are_removed(tmp_path):
    (tmp_path / "real.csv").write_text("old")
    (tmp_path / "link.csv").symlink_to(tmp_path / "real.csv")
    (tmp_path / ".real.csv.k2j_9xyz.part").write_text("half")
    write_atomically(tmp_path / "link.csv", "new")
    assert (tmp_path / "link.csv").is_symlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.csv", "real.csv"]
    assert (tmp_path / "real.csv").read_text() == "new"


def test_paths_that_are_too_long_are_rejected(tmp_path):
    for path in (tmp_path / ("x" * 5000), tmp_path / ("x" * 5000) / "y.csv"):
        with refused(OutputError, file=path, value="File name too long"):
            write_atomically(path, "text")
