"""Every exception that pisigma raises on purpose.

All messages have one form, which `PisigmaError` makes from its fields: ``expected X, got Y (file, line, column); do
Z.`` The command line prints any `PisigmaError` as one line on stderr and exits with status 2, with status 3 for an
`AcceptanceError`; every other exception is a defect of pisigma.
"""

import difflib
import os
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

LONGEST_WORD = 200
"""Letters of a word of a file or a command line that a message quotes."""

LONGEST_TEXT = 2000
"""Letters of a message."""

_UNPRINTABLE = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
_LONG_WORD = re.compile(rf"\S{{{LONGEST_WORD + 1},}}")


def printable(text: str, cut: bool = True) -> str:
    r"""Give a text as it may stand on a terminal, whatever a file has put into it.

    Control characters, marks of the direction of writing and halves of characters are written as `\x1b`, so that
    nothing moves the cursor, sets colours or hides what follows. Of words of more than `LONGEST_WORD` letters the begin
    and the length are given, and of texts of more than `LONGEST_TEXT` letters the begin and the end.

    Args:
        text: whatever it holds.
        cut: whether long words and texts are cut.
    """
    if cut:
        text = _LONG_WORD.sub(lambda match: f"{match[0][:40]}... ({len(match[0]):,} characters)", text)
    if cut and len(text) > LONGEST_TEXT:
        text = f"{text[: LONGEST_TEXT - 500]} ... {text[-400:]}"
    return _UNPRINTABLE.sub(lambda match: ascii(match[0])[1:-1], text)


@dataclass(frozen=True)
class Place:
    """Where in a file something is: ``str(Place("a.csv", 3, "x_mm"))`` is ``"a.csv, line 3, column 'x_mm'"``.

    Attributes:
        file: path of the file, as the user gave it, or another name of the source.
        line: line number, counted from 1; None where the whole file is meant.
        column: name or number (from 1) of a column of a table, or the key of a YAML file (`"joints.2.a_mm"`); None
            where the whole line is meant.
    """

    file: str | os.PathLike[str]
    line: int | None = None
    column: str | int | None = None

    def __str__(self) -> str:
        parts = [os.fspath(self.file)]
        if self.line is not None:
            parts.append(f"line {self.line}")
        if self.column is not None:
            is_key = os.fspath(self.file).endswith((".yaml", ".yml"))
            parts.append(f"{'key' if is_key else 'column'} {_quoted(self.column)}")
        return ", ".join(parts)


class PisigmaError(Exception):
    """Base of every error that pisigma raises on purpose.

    The message is made of the fields: ``expected a length > 0, got -3 mm (cell.yaml, line 12); give a positive
    length.`` It is made `printable`. All fields are attributes, so that callers need not parse the message.

    Attributes:
        file: the file at fault, None where no file is.
        line: its line, counted from 1; None where the whole file is meant.
        column: name or number of the column, or the YAML key; None where the whole line is meant.
        option: the option or the argument at fault, for example ``"--camera"``; empty where none is.
        value: what was given instead; None where that is not stated.
        expected: what was expected; empty where `problem` says what is wrong.
        remedy: what to do about it; empty where the message ends without it.
    """

    def __init__(
        self,
        problem: str = "",
        *,
        expected: str = "",
        value: Any = None,
        at: Place | None = None,
        option: str = "",
        remedy: str = "",
    ) -> None:
        """Make the message of its parts.

        Args:
            problem: what is wrong, a clause without a full stop; without it the message says
                ``expected ..., got ...``. Alone it is the whole message, as it is.
            expected: what was expected, for example ``"a length > 0"``.
            value: what was given instead.
            at: where in a file; it follows the problem in parentheses.
            option: the option or argument at fault; it precedes the problem.
            remedy: what to do about it, an imperative clause without a full stop.
        """
        self.file = None if at is None else os.fspath(at.file)
        self.line = None if at is None else at.line
        self.column = None if at is None else at.column
        self.option, self.value, self.expected, self.remedy = option, value, expected, remedy
        if expected and not problem:
            problem = (
                f"expected {expected}" if value is None else f"expected {expected}, got {_quoted(value)}"
            )
        sentence = "".join(
            (
                f"{option}: " if option else "",
                problem,
                f" ({at})" if at is not None else "",
                f"; {remedy}" if remedy else "",
            )
        )
        is_whole = (sentence == problem and not expected) or sentence.endswith((".", "?"))
        super().__init__(printable(sentence if is_whole else f"{sentence}."))

    def fields(self) -> dict[str, Any]:
        """The fields that are stated, for JSON: class, message and the attributes."""
        stated = {"class": type(self).__name__, "message": str(self)}
        names = ("file", "line", "column", "option", "value", "expected", "remedy")
        values = {name: getattr(self, name) for name in names}
        plain = {
            name: value if isinstance(value, bool | int | float | str) else printable(str(value))
            for name, value in values.items()
            if value is not None and value != ""
        }
        return stated | plain

    def followed_by(self, text: str) -> "PisigmaError":
        """The same error with a text after its message."""
        other = type(self)(f"{self}{text}")
        other.__dict__.update(self.__dict__)
        return other


def _quoted(value: Any) -> str:
    """A value as a message shows it: texts in quotation marks, numbers as they are."""
    if isinstance(value, str):
        return f"'{value}'"
    return f"{value:,.12g}" if isinstance(value, float) else str(value)


class RobotError(PisigmaError, ValueError):
    """A robot description cannot be used."""


class UnknownRobotError(RobotError):
    """A robot is neither in the catalogue nor a file."""


class RecipeError(PisigmaError, ValueError):
    """A recipe cannot be used."""


class MeasurementError(PisigmaError, ValueError):
    """A measurement file or data set cannot be used."""


class ModelError(PisigmaError, ValueError):
    """A model folder cannot be used."""


class PoseError(PisigmaError, ValueError):
    """A wanted pose is no pose, or joint values do not fit the robot."""


class RequestError(PisigmaError, ValueError):
    """A request to a server cannot be answered as it stands."""


class UnreachablePoseError(PisigmaError, ValueError):
    """The robot cannot take a wanted pose as asked; the message gives the status."""


class IdentificationError(PisigmaError, ValueError):
    """The measurements do not determine what is asked for."""


class ImplausibleError(IdentificationError):
    """No calibration error explains what was measured: it is of another robot, or in other units."""


class PlanningError(PisigmaError, ValueError):
    """A cell, a plan or the settings of one cannot be used."""


class FleetError(PisigmaError, ValueError):
    """A fleet cannot be read or its settings cannot be used."""


class PluginError(PisigmaError, ValueError):
    """A plug-in cannot be loaded."""


class OutputError(PisigmaError, ValueError):
    """An output cannot be written where it was asked for."""


class AcceptanceError(PisigmaError, ValueError):
    """A model does not meet the limits that were set for it, or must not be trusted."""


class TrainingError(PisigmaError, RuntimeError):
    """A training cannot go on, for example because it diverged."""


class MissingExtraError(PisigmaError, ImportError):
    """A package that comes with an extra of pisigma is not installed."""


EXTRAS = {
    "lightning": "train",
    "onnx": "onnx",
    "numba": "compile",
    "viser": "view",
    "pyarrow": "fleet",
    "ray": "ray",
    "pyzmq": "serve",
    "opencv-python-headless": "camera",
}
"""By the package that is imported on use, the extra that it comes with."""
_PACKAGES = {"cv2": "opencv-python-headless"}
"""Packages that are imported by another name."""


def missing_extra(problem: ImportError) -> MissingExtraError | None:
    """Say which extra brings the package that could not be imported; None where none does."""
    module = (problem.name or "").split(".")[0]
    package = _PACKAGES.get(module, module)
    if package not in EXTRAS:
        return None
    return MissingExtraError(
        f"this needs the package {package}, which is not installed; install it with "
        f'`pip install "pisigma[{EXTRAS[package]}]"`.'
    )


def check_choice(
    error: type[PisigmaError], name: str, value: str, choices: Collection[str], at: Place | None = None
) -> None:
    """Refuse a value that is not one of the valid choices.

    Args:
        error: class of the exception.
        name: the option, argument or key.
        value: what was given.
        choices: the valid ones.
        at: where in a file it was given.

    Raises:
        PisigmaError: of the class `error`, with the nearest choice.
    """
    if value not in choices:
        raise error(
            f"unknown value '{value}'",
            value=value,
            option=name,
            at=at,
            remedy=nearest_choice(str(value), choices),
        )


def nearest_choice(given: str, choices: Iterable[str]) -> str:
    """Say which choices there are and which is nearest to `given`.

    Returns:
        For example ``"did you mean 'epochs'? Valid: epochs, seed."``.
    """
    names = sorted(choices)
    close = difflib.get_close_matches(given, names, n=1)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"{hint}Valid: {', '.join(names)}."
