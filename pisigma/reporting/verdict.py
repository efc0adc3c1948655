"""A verdict on a result in three sentences, and numbers rounded to their meaningful digits."""

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pisigma.validation.held_out.validation_figures import ErrorFigures

_MANY_ROWS = 100
"""Number of rows from which errors are stated with three digits, because their RMS is known to a few percent."""
_SMALLEST = 1e-4
"""Size below which errors do not matter [mm or deg]."""


@dataclass(frozen=True)
class Verdict:
    """The essentials of a result for a user.

    Attributes:
        accuracy: how accurate the result is, with the kind of the figures.
        trust: whether to trust the result, and if not, why.
        next_step: recommended next step.
        heading: subject of the first sentence.
    """

    accuracy: str
    trust: str
    next_step: str
    heading: str = "Accuracy"

    @property
    def short(self) -> str:
        """The accuracy, and whether to trust the result, on one line."""
        accuracy = self.accuracy.partition("; ")[0].partition(". ")[0].rstrip(".")
        trust = re.split(r"[:,;.] ?", self.trust)[0]
        return f"Verdict: {accuracy}. Trust: {trust}."

    @property
    def lines(self) -> tuple[tuple[str, str], ...]:
        """The sentences, each after its heading."""
        return ((self.heading, self.accuracy), ("Trust", self.trust), ("Next", self.next_step))


def rounded_text(value: float, rows: int = _MANY_ROWS) -> str:
    """Return an error with three digits, or two if few rows were evaluated."""
    digits = 3 if rows >= _MANY_ROWS else 2
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    if abs(value) < _SMALLEST:
        return f"< {_SMALLEST:g}" if value > 0 else f"> -{_SMALLEST:g}"
    return f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}"


def uncapitalised(sentence: str) -> str:
    """Return a sentence with a lower-case first letter, to continue another sentence."""
    return sentence if sentence[1:2].isupper() else f"{sentence[:1].lower()}{sentence[1:]}"


def count_text(count: int, noun: str) -> str:
    """Return a number with a noun, such as "1 warning" or "2 warnings"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def rms_text(errors: "ErrorFigures", rows: int) -> str:
    """Return the RMS of positions and of orientations, as far as they are known, as text."""
    figures = ((errors.rms_mm, "mm"), (errors.rms_deg, "deg"))
    known = [f"{rounded_text(value, rows)} {unit}" for value, unit in figures if value is not None]
    return " and ".join(known) or "unknown"
