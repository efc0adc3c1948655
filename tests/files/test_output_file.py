"""Output files: whole or not at all."""

import os

import pytest

from pisigma.errors import OutputError
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
    with pytest.raises(OutputError, match="cannot be written"):
        write_whole(tmp_path / "none" / "out.csv", "text")
