"""Recognition of text encodings."""

import pytest
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.foreign.export_file import decode_text

TEXT = "Prüfpunkt;J1 [°]\n1;2,5\n"


@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "cp1252"]
)
def test_texts_come_back(encoding: str):
    assert decode_text(TEXT.replace("\n", "\r\n").encode(encoding), "a.csv") == TEXT


@pytest.mark.parametrize(
    ("content", "value"),
    [
        (b"PK\x03\x04abc", "a workbook or an archive"),
        (b"%PDF-1.7", "a PDF"),
        (b"\x1f\x8b\x08", "a compressed file"),
        (b"a\x00b\x01\x02", None),
        (b"\xff\xfea", None),
    ],
)
def test_binary_files_are_refused(content: bytes, value: str | None):
    with refused(MeasurementError, file="a.csv", value=value):
        decode_text(content, "a.csv")
