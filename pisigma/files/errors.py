"""Exceptions that pisigma raises on purpose.

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

MAX_WORD_CHARACTERS = 200
"""Largest number of characters of a word that a message quotes in full."""

MAX_MESSAGE_CHARACTERS = 2000
"""Largest number of characters of a message."""

_UNPRINTABLE = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
_LONG_WORD = re.compile(rf"\S{{{MAX_WORD_CHARACTERS + 1},}}")


def make_printable(text: str, cut: bool = True) -> str:
    r"""Return a text that is safe to print on a terminal, even if parts of it come from a file.

    Control characters, direction marks and surrogates are written as escapes (`\x1b`), so that nothing moves the
    cursor, sets colours or hides the text that follows. A word longer than `MAX_WORD_CHARACTERS` is replaced by its
    start and its length, and a text longer than `MAX_MESSAGE_CHARACTERS` by its start and its end.

    Args:
        text: any text.
        cut: whether to shorten long words and texts.
    """
    if cut:
        text = _LONG_WORD.sub(lambda match: f"{match[0][:40]}... ({len(match[0]):,} characters)", text)
    if cut and len(text) > MAX_MESSAGE_CHARACTERS:
        text = f"{text[: MAX_MESSAGE_CHARACTERS - 500]} ... {text[-400:]}"
    return _UNPRINTABLE.sub(lambda match: ascii(match[0])[1:-1], text)


@dataclass(frozen=True)
class Place:
    """A place in a file: ``str(Place("a.csv", 3, "x_mm"))`` is ``"a.csv, line 3, column 'x_mm'"``.

    Attributes:
        file: path of the file as the user gave it, or another name of the source.
        line: line number, counted from 1; None for the whole file.
        column: name or number (from 1) of a column of a table, or the key of a YAML file (`"joints.2.a_mm"`); None
            for the whole line.
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


class Phrase(str):
    """A value that is described in words, such as ``"none"``; a message does not put it in quotation marks."""


class PisigmaError(Exception):
    """Base class of every error that pisigma raises on purpose.

    The message is built from the fields: ``expected a length > 0, got -3 mm (cell.yaml, line 12); give a positive
    length.`` It is printable, see `make_printable`. All fields are attributes, so that callers need not parse it.

    Attributes:
        file: the file that caused the error; None if the error is not in a file.
        line: line number in the file, counted from 1; None for the whole file.
        column: name or number of the column, or the YAML key; None for the whole line.
        option: the option or argument that caused the error, for example ``"--camera"``; empty if none did.
        value: the value that was given; None if it is unknown.
        expected: what was expected; empty if `problem` states what is wrong.
        problem: a clause that states what is wrong; empty if the message states what was expected.
        remedy: how to correct the input; empty if the message does not state it.
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
        """Build the message from its parts.

        Args:
            problem: a clause without a full stop that states what is wrong; if omitted, the message says ``expected
                ..., got ...``. Without any other argument it is the whole message, unchanged.
            expected: what was expected, for example ``"a length > 0"``.
            value: the value that was given.
            at: the place in a file; the message gives it in parentheses after the problem.
            option: the option or argument that caused the error; the message names it before the problem.
            remedy: how to correct the input, an imperative clause without a full stop.
        """
        self.file = None if at is None else os.fspath(at.file)
        self.line = None if at is None else at.line
        self.column = None if at is None else at.column
        self.option, self.value, self.expected, self.remedy = option, value, expected, remedy
        self.problem, self._follows = problem, ""
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
        super().__init__(make_printable(sentence if is_whole else f"{sentence}."))

    def fields(self) -> dict[str, Any]:
        """Return the class name, the message and all attributes that are set, as plain values for JSON."""
        stated = {"class": type(self).__name__, "message": str(self)}
        names = ("file", "line", "column", "option", "value", "expected", "remedy")
        values = {name: getattr(self, name) for name in names}
        plain = {
            name: value if isinstance(value, bool | int | float | str) else make_printable(str(value))
            for name, value in values.items()
            if value is not None and value != ""
        }
        return stated | plain

    def with_text_after(self, text: str) -> "PisigmaError":
        """Return a copy of the error with a text after its message."""
        other = type(self)(f"{self}{text}")
        other.__dict__.update(self.__dict__)
        other._follows = self._follows + text
        return other

    def with_option(self, option: str) -> "PisigmaError":
        """Return a copy with another option name; an error in a file is returned unchanged."""
        if option == self.option or self.file is not None or self._follows:
            return self
        fields = {name: getattr(self, name) for name in ("expected", "value", "remedy")}
        return type(self)(self.problem.rstrip("."), option=option, **fields)

    def with_place(self, at: Place, error: "type[PisigmaError] | None" = None) -> "PisigmaError":
        """Return a copy of the error with a place in a file, for code that knows the file although the cause does not.

        Args:
            at: the place in a file. If the error already has a place, the new message begins with `at` instead.
            error: class of the copy; None for the class of this error.
        """
        make = error or type(self)
        if self.file is None and not self._follows:
            names = ("expected", "value", "option", "remedy")
            fields = {name: getattr(self, name) for name in names}
            return make(self.problem.rstrip("."), at=at, **fields)
        other = make(f"{at}: {self}")
        other.__dict__.update(self.__dict__)
        if self.file is None:
            other.file, other.line, other.column = os.fspath(at.file), at.line, at.column
        return other


def _quoted(value: Any) -> str:
    """Format a value for a message: texts in quotation marks, numbers and phrases without."""
    if isinstance(value, str) and not isinstance(value, Phrase):
        return f"'{value}'"
    return f"{value:,.12g}" if isinstance(value, float) else str(value)


class RobotError(PisigmaError, ValueError):
    """A robot description cannot be used."""


class UnknownRobotError(RobotError):
    """A robot is neither in the catalogue nor a file."""


class SettingError(PisigmaError, ValueError):
    """A setting has an unknown name, or a value of the wrong type or out of range."""


class RecipeError(PisigmaError, ValueError):
    """A recipe cannot be used."""


class MeasurementError(PisigmaError, ValueError):
    """A measurement file or data set cannot be used."""


class ModelError(PisigmaError, ValueError):
    """A model folder cannot be used."""


class PoseError(PisigmaError, ValueError):
    """A target pose is not a valid pose, or joint values do not fit the robot."""


class RequestError(PisigmaError, ValueError):
    """A request to a server is invalid."""


class UnreachablePoseError(PisigmaError, ValueError):
    """The robot cannot reach a target pose under the stated conditions; the message states the status."""


class IdentificationError(PisigmaError, ValueError):
    """The measurements do not determine the requested parameters."""


class ImplausibleError(IdentificationError):
    """No geometric errors of the robot explain the measurements: they belong to another robot or are in other units."""


class PlanningError(PisigmaError, ValueError):
    """A cell, a plan, or the settings of a plan cannot be used."""


class FleetError(PisigmaError, ValueError):
    """A fleet cannot be read or its settings cannot be used."""


class PluginError(PisigmaError, ValueError):
    """A plug-in cannot be loaded."""


class OutputError(PisigmaError, ValueError):
    """An output cannot be written to the requested place."""


class AcceptanceError(PisigmaError, ValueError):
    """A model exceeds the limits that were set for it, or the rows or the model must not be trusted.

    Attributes:
        findings: what the checks of rows found (`pisigma.validation.held_out.diagnostic.Diagnostic`).
    """

    findings: tuple[Any, ...] = ()


class TrainingError(PisigmaError, RuntimeError):
    """A training cannot continue, for example because it diverged."""


class MissingExtraError(PisigmaError, ImportError):
    """A package of one of pisigma's extras is not installed."""


EXTRAS = {
    "lightning": "train",
    "onnx": "onnx",
    "numba": "compile",
    "viser": "view",
    "aiohttp": "view",
    "pyarrow": "fleet",
    "ray": "ray",
    "pyzmq": "serve",
    "asyncua": "opcua",
    "opencv-python-headless": "camera",
    "pin": "bench",
}
"""Name of the extra (`pip install pisigma[EXTRA]`) that installs each optional package."""
_PACKAGES = {"cv2": "opencv-python-headless", "pinocchio": "pin"}
"""Names of packages whose module has a different name, by module name."""
_NOT_IN_IK = {
    "PIL",
    "jinja2",
    "lxml",
    "markupsafe",
    "matplotlib",
    "pytorch_kinematics",
    "safetensors",
    "scipy",
    "torch",
}
"""Modules that `pisigma` requires, and `pisigma-ik` (packaging/pisigma-ik) does not."""


def system_problem_text(problem: BaseException) -> str:
    """Describe a file that cannot be used, or a lack of memory; return "" for every other problem."""
    if isinstance(problem, OSError) and problem.filename is not None:
        return f"{problem.filename} cannot be used: {problem.strerror}; check the path."
    if isinstance(problem, MemoryError):
        return "there is not enough memory; give fewer or smaller inputs."
    return ""


def missing_extra(problem: ImportError) -> MissingExtraError | None:
    """Return an error that states how to install a package that could not be imported; None for other packages."""
    module = (problem.name or "").split(".")[0]
    if module in _NOT_IN_IK:
        return MissingExtraError(
            f"this needs the package {module}, which is not installed with pisigma-ik",
            value=module,
            remedy="run `pip uninstall pisigma-ik` and `pip install pisigma`, which includes all commands",
        )
    package = _PACKAGES.get(module, module)
    if package not in EXTRAS:
        return None
    return MissingExtraError(
        f"this needs the package {package}, which is not installed",
        value=package,
        remedy=f'install it with `pip install "pisigma[{EXTRAS[package]}]"`',
    )


def check_choice(
    error: type[PisigmaError], name: str, value: str, choices: Collection[str], at: Place | None = None
) -> None:
    """Check that a value is one of the valid choices.

    Args:
        error: class of the exception.
        name: the option, argument or key.
        value: the value to check.
        choices: the valid values.
        at: place in a file at which the value was given.

    Raises:
        PisigmaError: the value is not valid; the exception has the class `error` and names the nearest choice.
    """
    if value not in choices:
        raise error(
            f"unknown value '{value}'",
            value=value,
            option=name,
            at=at,
            remedy=choice_remedy(str(value), choices),
        )


def choice_remedy(given: str, choices: Iterable[str]) -> str:
    """Return a remedy that lists the valid choices and suggests the one nearest to `given`.

    Returns:
        For example ``"did you mean 'epochs'? Valid: epochs, seed."``.
    """
    names = sorted(choices)
    close = difflib.get_close_matches(given, names, n=1)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"{hint}Valid: {', '.join(names)}."
