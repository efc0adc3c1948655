"""Damage to any text file: bytes, lines, cells and words, regardless of the format."""

import re

from hostile.case import Rng, one_of

NUMBERS = (
    "1e300", "-1e300", "1e-320", "1e9", "-0", "0", "inf", "-inf", "nan", "NaN", "0x1F", "1_000", "1,5", "1.234,5",
    "1'000", "1 000", "12.5 mm", "10°", "+-3", "--3", "1e", "1.2.3", "１２", "٣", "#N/A", "null", "None", "N/A", "-",
    "-999", "9999999", "2026-11-22", "12:30", "=1+1", "true", "1e999", "9" * 400, "0." + "3" * 400, "1d5", "½",
)  # fmt: skip
"""Cells in place of a number."""
TEXTS = (
    "", " ", "'", '"', '""', "\\", "\x00", "\x1b[31mred\x1b[0m", "\x07", "\u202eabc", "\ufeff", "ä", "🤖", "a" * 5000,
    "a\tb", ";", "#", "../../etc/passwd", "{{7*7}}", "<script>alert(1)</script>", "%s%n", "\x85", "\u2028", "CON",
    "~", "$HOME",
)  # fmt: skip
"""Words in place of a text."""
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9]+")


def damaged(rng: Rng, content: bytes) -> tuple[str, bytes]:
    """Damage the content of a text file, and return it with a description of the damage."""
    harm = one_of(rng, (*_WHOLE, *_LINES, *_INSIDE, *_INSIDE))
    return harm.__name__.strip("_").replace("_", " "), harm(rng, content)


def _empty(rng: Rng, content: bytes) -> bytes:
    return one_of(rng, (b"", b"\n", b"   ", b"\xef\xbb\xbf", b"# nothing\n"))


def _truncated(rng: Rng, content: bytes) -> bytes:
    return content[: int(rng.integers(len(content)))]


def _in_another_encoding(rng: Rng, content: bytes) -> bytes:
    text = content.decode("utf-8", errors="replace") + "ü"
    return text.encode(
        one_of(rng, ("utf-16", "utf-32", "latin-1", "utf-16-be", "utf-7", "cp037")), errors="replace"
    )


def _with_a_byte_order_mark(rng: Rng, content: bytes) -> bytes:
    return b"\xef\xbb\xbf" + content


def _compressed(rng: Rng, content: bytes) -> bytes:
    import gzip

    return one_of(rng, (gzip.compress(content, mtime=0), b"PK\x03\x04" + content, b"%PDF-1.7\n" + content))


def _random_bytes(rng: Rng, content: bytes) -> bytes:
    return rng.bytes(int(rng.integers(1, 4000)))


def _bytes_flipped(rng: Rng, content: bytes) -> bytes:
    changed = bytearray(content)
    for index in rng.integers(len(changed), size=int(rng.integers(1, 20))):
        changed[index] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _control_characters(rng: Rng, content: bytes) -> bytes:
    index = int(rng.integers(len(content)))
    return (
        content[:index]
        + one_of(rng, (b"\x00", b"\x1b[2J", b"\x07", b"\x0c", b"\x0b", b"\x1a", b"\xc2\x9b"))
        + content[index:]
    )


def _other_line_ends(rng: Rng, content: bytes) -> bytes:
    return content.replace(b"\n", one_of(rng, (b"\r\n", b"\r", b"\n\n", b"\n\r", b"\xe2\x80\xa8", b"\x0b")))


def _other_separators(rng: Rng, content: bytes) -> bytes:
    return content.replace(b",", one_of(rng, (b";", b"\t", b" ", b"|", b", ", b",,")))


def _decimal_commas(rng: Rng, content: bytes) -> bytes:
    return content.replace(b",", one_of(rng, (b";", b","))).replace(b".", b",")


def _a_million_characters(rng: Rng, content: bytes) -> bytes:
    index = int(rng.integers(len(content)))
    return (
        content[:index]
        + one_of(rng, (b"7", b"x", b" ", b'"', b"\n", b",", b"[", b"{a: ")) * 1_000_000
        + content[index:]
    )


def _repeated(rng: Rng, content: bytes) -> bytes:
    return content * int(rng.integers(2, 6))


def _lines_of(rng: Rng, content: bytes) -> tuple[list[bytes], int]:
    lines = content.split(b"\n")
    return lines, int(rng.integers(len(lines)))


def _without_a_line(rng: Rng, content: bytes) -> bytes:
    lines, index = _lines_of(rng, content)
    return b"\n".join(lines[:index] + lines[index + 1 :])


def _without_the_first_line(rng: Rng, content: bytes) -> bytes:
    return b"\n".join(content.split(b"\n")[1:])


def _with_a_line_twice(rng: Rng, content: bytes) -> bytes:
    lines, index = _lines_of(rng, content)
    return b"\n".join([*lines[:index], *[lines[index]] * int(rng.integers(1, 50)), *lines[index:]])


def _the_first_line_again(rng: Rng, content: bytes) -> bytes:
    lines, index = _lines_of(rng, content)
    return b"\n".join([*lines[:index], lines[0], *lines[index:]])


def _with_lines_exchanged(rng: Rng, content: bytes) -> bytes:
    lines, index = _lines_of(rng, content)
    other = int(rng.integers(len(lines)))
    lines[index], lines[other] = lines[other], lines[index]
    return b"\n".join(lines)


def _with_a_line_of_rubbish(rng: Rng, content: bytes) -> bytes:
    lines, index = _lines_of(rng, content)
    return b"\n".join([*lines[:index], one_of(rng, (*TEXTS, *NUMBERS)).encode(), *lines[index:]])


def _replaced(rng: Rng, content: bytes, pattern: re.Pattern[bytes], by: str) -> bytes:
    places = list(pattern.finditer(content))
    if not places:
        return content + by.encode()
    place = one_of(rng, places)
    return content[: place.start()] + by.encode() + content[place.end() :]


def _a_number_replaced(rng: Rng, content: bytes) -> bytes:
    return _replaced(rng, content, _NUMBER, one_of(rng, NUMBERS))


def _a_number_made_a_text(rng: Rng, content: bytes) -> bytes:
    return _replaced(rng, content, _NUMBER, one_of(rng, TEXTS))


def _a_word_replaced(rng: Rng, content: bytes) -> bytes:
    return _replaced(rng, content, _WORD, one_of(rng, (*TEXTS, *NUMBERS)))


def _a_word_misspelt(rng: Rng, content: bytes) -> bytes:
    places = list(_WORD.finditer(content))
    if not places:
        return content
    place = one_of(rng, places)
    word = place[0]
    index = int(rng.integers(len(word)))
    changed = one_of(
        rng, (word[:index] + word[index + 1 :], word.upper(), word + word[-1:], word.replace(b"_", b" "))
    )
    return content[: place.start()] + changed + content[place.end() :]


def _a_cell_more(rng: Rng, content: bytes) -> bytes:
    lines, index = _lines_of(rng, content)
    lines[index] += b"," + one_of(rng, NUMBERS).encode()
    return b"\n".join(lines)


def _a_cell_less(rng: Rng, content: bytes) -> bytes:
    lines, index = _lines_of(rng, content)
    lines[index] = lines[index].rpartition(b",")[0]
    return b"\n".join(lines)


_WHOLE = (
    _empty, _truncated, _in_another_encoding, _with_a_byte_order_mark, _compressed, _random_bytes, _bytes_flipped,
    _control_characters, _other_line_ends, _other_separators, _decimal_commas, _a_million_characters, _repeated,
)  # fmt: skip
_LINES = (
    _without_a_line, _without_the_first_line, _with_a_line_twice, _the_first_line_again, _with_lines_exchanged,
    _with_a_line_of_rubbish,
)  # fmt: skip
_INSIDE = (
    _a_number_replaced, _a_number_made_a_text, _a_word_replaced, _a_word_misspelt, _a_cell_more, _a_cell_less,
)  # fmt: skip
