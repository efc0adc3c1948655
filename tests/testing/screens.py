"""What a command prints for people: the verdict first and last, on one screen; never its sentences."""

import re

MAX_LINES = 40
SHORT = 12
WIDTH = 80


def assert_screen(text: str, *words: str, heading: str = "Accuracy", verbose: bool = False) -> None:
    """Assert that a result begins and ends with its verdict and fits a screen.

    Args:
        text: what was printed.
        *words: names and numbers that it has to contain.
        heading: of the first line.
        verbose: whether everything was asked for, which may be longer.
    """
    lines = text.splitlines()
    labels = [line.partition(": ")[0] for line in lines if re.match(r"[A-Z][a-z]+: ", line)]
    assert labels[:2] == [heading, "Trust"], text
    assert all(len(line) <= WIDTH or "/" in line for line in lines), text  # names of files stay whole
    warnings = sum(line.startswith("Warning: ") for line in lines)
    assert verbose or len(lines) <= MAX_LINES + 8 * warnings, text
    if len(lines) > SHORT:
        assert labels[-1] == "Verdict", text
    whole = " ".join(text.split())
    for word in words:
        assert word in whole, f"{word!r} is not in\n{text}"
