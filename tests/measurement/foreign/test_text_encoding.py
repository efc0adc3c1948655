"""Encodings that nobody states."""

import pytest

from pisigma.files.errors import MeasurementError
from pisigma.measurement.foreign.export_file import decoded

TEXT = "Prüfpunkt;J1 [°]\n1;2,5\n"


@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "cp1252"]
)
def test_texts_come_back(encoding: str):
    assert decoded(TEXT.replace("\n", "\r\n").encode(encoding), "a.csv") == TEXT


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"PK\x03\x04abc", "workbook"),
        (b"%PDF-1.7", "PDF"),
        (b"\x1f\x8b\x08", "unpack"),
        (b"a\x00b\x01\x02", "is no text"),
        (b"\xff\xfea", "is no text"),
    ],
)
def test_what_is_no_text_is_refused(content: bytes, said: str):
    with pytest.raises(MeasurementError, match=said):
        decoded(content, "a.csv")
