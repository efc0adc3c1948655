"""Every exception that pisigma raises on purpose.

A message says what was wanted, what came, where, and what to do about it. The command line turns any
`PisigmaError` into one line on stderr and exit status 2, an `AcceptanceError` into status 3; everything else is a
defect of ours.
"""

import difflib
import re
from collections.abc import Collection, Iterable

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


class PisigmaError(Exception):
    """Base of every error that pisigma raises on purpose; its sentence is `printable`."""

    def __init__(self, sentence: str = ""):
        super().__init__(printable(sentence))


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


def check_choice(error: type[PisigmaError], name: str, value: str, choices: Collection[str]) -> None:
    """Refuse what is no choice.

    Raises:
        PisigmaError: of the class `error`, with the nearest choice.
    """
    if value not in choices:
        raise error(f"{name} '{value}' is unknown; {nearest_choice(str(value), choices)}")


def nearest_choice(given: str, choices: Iterable[str]) -> str:
    """Say which choices there are and which is nearest to `given`.

    Returns:
        For example ``"did you mean 'epochs'? Valid: epochs, seed."``.
    """
    names = sorted(choices)
    close = difflib.get_close_matches(given, names, n=1)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"{hint}Valid: {', '.join(names)}."
