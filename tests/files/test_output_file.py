"""Output files: whole or not at all."""

import os

import pytest

from pisigma.files.errors import OutputError
from pisigma.files.output_file import check_output, write_whole


def test_a_file_is_replaced_whole(tmp_path):
    path = tmp_path / "out.csv"
    path.write_text("old")
    check_output(path, (".csv",), "a table")
    write_whole(path, "new\n")
    assert path.read_bytes() == b"new\n"
    assert path.stat().st_mode & 0o777 == 0o644
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_is_left_when_it_cannot_be_moved_there(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    (tmp_path / "out.csv").write_text("old")
    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OutputError, match=r"cannot be written \(No space left"):
        write_whole(tmp_path / "out.csv", "new")
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("out.csv", "old")]


def test_where_nothing_can_be_written(tmp_path):
    (tmp_path / "folder.csv").mkdir()
    for path, complaint in (
        (tmp_path / "out.txt", "a table goes into a .csv or .yaml file"),
        (tmp_path / "folder.csv", "is a folder"),
        (tmp_path / "none" / "out.csv", "there is no folder"),
    ):
        with pytest.raises(OutputError, match=complaint):
            check_output(path, (".csv", ".yaml"), "a table")
    with pytest.raises(OutputError, match="there is no folder"):
        write_whole(tmp_path / "none" / "out.csv", "text")


def test_an_input_is_never_overwritten(tmp_path):
    source = tmp_path / "in.csv"
    source.write_text("mine")
    (tmp_path / "soft.csv").symlink_to(source)
    os.link(source, tmp_path / "hard.csv")
    for name in ("in.csv", "soft.csv", "hard.csv", "../" + tmp_path.name + "/in.csv"):
        with pytest.raises(OutputError, match="is an input of this command; choose another --out"):
            check_output(tmp_path / name, inputs=("no robot", source))
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match=r"out\.csv: lies in .*folder, an input of this command"):
        check_output(tmp_path / "folder" / "out.csv", inputs=(tmp_path / "folder",))
    assert source.read_text() == "mine"


def test_a_part_of_a_model_is_never_overwritten(tmp_path):
    (tmp_path / "model.yaml").write_text("format: 4\n")
    (tmp_path / "sub").mkdir()
    for path in (tmp_path / "model.yaml", tmp_path / "sub" / "new.csv"):
        with pytest.raises(OutputError, match="lies in the model folder"):
            write_whole(path, "text")
    assert (tmp_path / "model.yaml").read_text() == "format: 4\n"


def test_a_pipe_is_no_file_to_replace(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(OutputError, match="is no regular file, but a device or a pipe"):
        write_whole(tmp_path / "pipe.csv", "text")


def test_a_linked_file_stays_linked_and_what_a_kill_left_is_swept(tmp_path):
    (tmp_path / "real.csv").write_text("old")
    (tmp_path / "link.csv").symlink_to(tmp_path / "real.csv")
    (tmp_path / ".real.csv.k2j_9xyz.part").write_text("half")
    write_whole(tmp_path / "link.csv", "new")
    assert (tmp_path / "link.csv").is_symlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.csv", "real.csv"]
    assert (tmp_path / "real.csv").read_text() == "new"


def test_paths_that_are_too_long_are_refused(tmp_path):
    for path in (tmp_path / ("x" * 5000), tmp_path / ("x" * 5000) / "y.csv"):
        with pytest.raises(OutputError, match="File name too long"):
            write_whole(path, "text")
