"""Files are read whole or rejected before they cost memory or time."""

import os
from pathlib import Path

import pytest
from testing.refusals import refused

from pisigma.files import input_file
from pisigma.files.errors import MeasurementError, RecipeError
from pisigma.files.input_file import read_input, read_text


def test_a_file_is_read_whole(tmp_path: Path):
    (path := tmp_path / "a").write_bytes(bytes(range(256)) * 10_000)
    assert read_input(path, MeasurementError) == bytes(range(256)) * 10_000


def test_a_file_too_large_is_rejected_before_it_is_read(tmp_path: Path):
    (path := tmp_path / "a").touch()
    os.truncate(path, 20 * 10**9)
    with refused(MeasurementError, file=path, expected=f"{2**26} bytes or fewer"):
        read_input(path, MeasurementError)
    with refused(MeasurementError, file="/dev/zero", expected=f"{2**26} bytes or fewer"):
        read_input("/dev/zero", MeasurementError)


@pytest.mark.parametrize("name", ["missing", ".", "a\0b", "a" * 5000, "\udcff"])
def test_missing_files_folders_and_invalid_names_are_rejected(tmp_path: Path, name: str):
    with refused(RecipeError, file=tmp_path / name, line=None):
        read_input(tmp_path / name, RecipeError)


def test_a_pipe_is_read_unless_it_delivers_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    reading, writing = os.pipe()
    os.write(writing, b"name: x")
    os.close(writing)
    assert read_input(f"/dev/fd/{reading}", RecipeError) == b"name: x"
    os.close(reading)
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.setattr(input_file, "MAX_WAIT_S", 0.05)
    with refused(RecipeError, file="pipe", value="no data within 0.05 s"):
        read_input(tmp_path / "pipe", RecipeError)


def test_a_text_is_in_utf_8(tmp_path: Path):
    (path := tmp_path / "a.csv").write_bytes(b"\xef\xbb\xbfq1_deg\n\xfc\n")
    with refused(MeasurementError, file="a.csv", line=2, expected="UTF-8 text", value="0xfc"):
        read_text(path, MeasurementError, "CSV")
    path.write_bytes(b"\xef\xbb\xbfq1_deg\n")
    assert read_text(path, MeasurementError, "CSV") == "q1_deg\n"
