"""What is wrong with which row of a measurement file."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool


class Faults:
    """What is wrong with which row; the first finding of a row stays.

    Attributes:
        reasons: column at fault, what stands there and what to do, by row.
    """

    def __init__(self, broken: dict[int, str]):
        self.reasons = {
            row: f"all columns: no valid CSV ({what}); check the quotes" for row, what in broken.items()
        }

    def add(self, rows: Bool[np.ndarray, " rows"], describe: Callable[[int], str]) -> None:
        """Note rows at fault; `describe` says what is wrong with one of them."""
        for row in np.flatnonzero(rows).tolist():
            if row not in self.reasons:
                self.reasons[row] = describe(row)

    def sound(self, rows: int) -> Bool[np.ndarray, " rows"]:
        """The rows without a fault so far, of so many."""
        sound = np.ones(rows, dtype=bool)
        sound[list(self.reasons)] = False
        return sound
