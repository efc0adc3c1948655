"""Files are read whole or refused with a sentence, before they cost memory or time."""

import os
from pathlib import Path

import pytest

from pisigma.files import input_file
from pisigma.files.errors import MeasurementError, RecipeError
from pisigma.files.input_file import read_input, read_text


def test_a_file_is_read_whole(tmp_path: Path):
    (path := tmp_path / "a").write_bytes(bytes(range(256)) * 10_000)
    assert read_input(path, MeasurementError) == bytes(range(256)) * 10_000


def test_a_file_too_large_is_refused_before_it_is_read(tmp_path: Path):
    (path := tmp_path / "a").touch()
    os.truncate(path, 20 * 10**9)
    with pytest.raises(MeasurementError, match="has more than 67 MB"):
        read_input(path, MeasurementError)
    with pytest.raises(MeasurementError, match="has more than 67 MB"):
        read_input("/dev/zero", MeasurementError)


@pytest.mark.parametrize("name", ["missing", ".", "a\0b", "a" * 5000, "\udcff"])
def test_what_is_no_file_is_refused(tmp_path: Path, name: str):
    with pytest.raises(RecipeError, match="check the path"):
        read_input(tmp_path / name, RecipeError)


def test_a_pipe_is_read_unless_nothing_comes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    reading, writing = os.pipe()
    os.write(writing, b"name: x")
    os.close(writing)
    assert read_input(f"/dev/fd/{reading}", RecipeError) == b"name: x"
    os.close(reading)
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.setattr(input_file, "LONGEST_WAIT", 0.05)
    with pytest.raises(RecipeError, match="nothing came"):
        read_input(tmp_path / "pipe", RecipeError)


def test_a_text_is_in_utf_8(tmp_path: Path):
    (path := tmp_path / "a.csv").write_bytes(b"\xef\xbb\xbfq1_deg\n\xfc\n")
    with pytest.raises(MeasurementError, match=r"a\.csv, line 2: is not UTF-8 text; save the file as CSV"):
        read_text(path, MeasurementError, "CSV")
    path.write_bytes(b"\xef\xbb\xbfq1_deg\n")
    assert read_text(path, MeasurementError, "CSV") == "q1_deg\n"
