"""A hostile input: files in a folder, the command that reads them, and its allowed results."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from hostile.clean import Clean, CleanRows

Rng = np.random.Generator
Choice = TypeVar("Choice")


@dataclass(frozen=True)
class Case:
    """One hostile input.

    Attributes:
        what: description of the change, and of the clean input.
        arguments: arguments of the command, which runs in the folder of the case.
        truth: clean measurements, on whose other rows a model is evaluated; None where the truth is unknown.
        healthy: whether the input is correct, so that it has to be accepted.
        check: returns a fault of the outputs of an accepted command; "" without one.
    """

    what: str
    arguments: tuple[str, ...]
    truth: CleanRows | None = None
    healthy: bool = False
    check: Callable[[Path], str] | None = None


Generator = Callable[[Rng, Clean, Path], Case]
"""Writes a hostile input into an empty folder."""


def one_of(rng: Rng, choices: Sequence[Choice]) -> Choice:
    """Draw one of the choices."""
    return choices[int(rng.integers(len(choices)))]


def calibrate(robot: str, data: str, *more: str) -> tuple[str, ...]:
    """Return the arguments of a quick calibration that writes the folder `out`."""
    return ("calibrate", robot, data, "--out", "out", "--model", "geometric", "--folds", "0", *more)
