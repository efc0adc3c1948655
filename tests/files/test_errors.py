"""Messages may stand on a terminal, whatever a file has put into them."""

import pytest

from pisigma.files.errors import LONGEST_TEXT, MissingExtraError, RobotError, printable


@pytest.mark.parametrize("odd", ["\x1b[31m", "\x00", "\x9b2J", "\u202e", "\udcff", "\x07", "\r"])
def test_what_moves_the_cursor_is_written_out(odd: str):
    sentence = str(RobotError(f"row '{odd}': unknown"))
    assert sentence == f"row '{ascii(odd)[1:-1]}': unknown"
    assert sentence.isprintable()


def test_what_people_write_stays():
    assert printable("Größe 10°, 測定, a\tb\nc") == "Größe 10°, 測定, a\tb\nc"


def test_long_words_and_texts_are_cut():
    assert printable(f"'{'x' * 1_000_000}' is unknown") == f"'{'x' * 39}... (1,000,002 characters) is unknown"
    shown = str(MissingExtraError("no " * 1_000_000 + "end"))
    assert len(shown) < LONGEST_TEXT
    assert shown.endswith("no end")
