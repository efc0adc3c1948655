"""A hostile input: files in a folder, the command that is to read them, and what is allowed to come of it."""

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
        what: was done to which clean input.
        arguments: of the command, which runs in the folder of the case.
        truth: clean measurements whose other rows a model is held against; None where there is no truth.
        healthy: nothing is wrong with it, so that it has to be accepted.
        check: says what is wrong with what the accepted command wrote into the folder; "" where nothing is.
    """

    what: str
    arguments: tuple[str, ...]
    truth: CleanRows | None = None
    healthy: bool = False
    check: Callable[[Path], str] | None = None


Generator = Callable[[Rng, Clean, Path], Case]
"""Writes a hostile input into an empty folder."""


def one_of(rng: Rng, choices: Sequence[Choice]) -> Choice:
    """Draw one of some choices of any type."""
    return choices[int(rng.integers(len(choices)))]


def calibrate(robot: str, data: str, *more: str) -> tuple[str, ...]:
    """The arguments of a quick calibration that writes the folder `out`."""
    return ("calibrate", robot, data, "--out", "out", "--model", "geometric", "--folds", "0", *more)
