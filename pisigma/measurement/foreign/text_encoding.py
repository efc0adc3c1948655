"""The text of a file whose encoding nobody states."""

import codecs

from pisigma.files.errors import MeasurementError

_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),  # begins with the mark of UTF-16
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_NO_TEXT = {
    b"PK\x03\x04": "a workbook or an archive; save its sheet as CSV",
    b"\xd0\xcf\x11\xe0": "an old Excel workbook; save its sheet as CSV",
    b"%PDF": "a PDF; export the measurements as text",
    b"\x1f\x8b": "compressed; unpack it",
}
_CONTROLS = frozenset(map(chr, range(32))) - set("\t\n\r\x0b\x0c\x1a")
"""Characters that no text holds; old exports end with the end-of-file mark 1A."""


def decoded(content: bytes, source: str) -> str:
    """Decode a text: by its byte order mark, as UTF-16 without one, as UTF-8, else as Windows-1252.

    Args:
        content: of the file.
        source: the file, as complaints call it.

    Raises:
        MeasurementError: it is no text.
    """
    for start, what in _NO_TEXT.items():
        if content.startswith(start):
            raise MeasurementError(f"{source}: is {what}.")
    encoding, mark = next(((name, mark) for mark, name in _MARKS if content.startswith(mark)), ("", b""))
    for attempt in (encoding,) if encoding else (_utf16_without_mark(content), "utf-8", "cp1252"):
        try:
            text = content[len(mark) :].decode(attempt) if attempt else ""
        except UnicodeDecodeError:
            continue
        if attempt and not _CONTROLS & set(text):
            return text.rstrip("\x1a").replace("\r\n", "\n").replace("\r", "\n")
    raise MeasurementError(f"{source}: is no text in UTF-8, UTF-16 or Windows-1252; export it as text.")


def _utf16_without_mark(content: bytes) -> str:
    """The byte order of UTF-16, of whose characters nearly all have a zero byte; "" where the text is no UTF-16."""
    even, odd = content[0:4096:2].count(0), content[1:4096:2].count(0)
    most = 0.4 * min(len(content), 4096) / 2
    return "utf-16-le" if odd > most > even else "utf-16-be" if even > most > odd else ""
