"""Stored results by series, split and method."""

from dataclasses import dataclass
from functools import cached_property

import pyarrow as pa

from shared_benchmark.methods import NAMES as METHODS
from shared_benchmark.methods import method_of
from shared_benchmark.scores import RowErrors
from shared_benchmark.series import NAMES as SERIES
from shared_benchmark.splits import SPLITS
from shared_benchmark.store import errors_of

OURS = "hybrid"
"""The method that is compared with the others."""

Key = tuple[str, str, str]
"""Series, split and method."""


@dataclass(frozen=True, eq=False)
class Results:
    """Stored results.

    Attributes:
        fits: table of fits.
        rows: table of held-out rows.
    """

    fits: pa.Table
    rows: pa.Table

    @cached_property
    def statuses(self) -> dict[Key, tuple[str, ...]]:
        """Statuses of the folds, by series, split and method."""
        found: dict[Key, tuple[str, ...]] = {}
        for fit in self.fits.to_pylist():
            key = fit["series"], fit["split"], fit["method"]
            found[key] = (*found.get(key, ()), fit["status"])
        return found

    @cached_property
    def errors(self) -> dict[Key, RowErrors]:
        """Errors of the held-out rows of all folds, by series, split and method, if no fold failed."""
        return {
            key: errors_of(self.rows, *key)
            for key, statuses in self.statuses.items()
            if set(statuses) == {"done"}
        }

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Series and splits with results, in the order of the page."""
        there = {key[:2] for key in self.statuses}
        return [(name, split) for name in SERIES for split in SPLITS if (name, split) in there]

    def peers(self, name: str, split: str) -> dict[str, RowErrors]:
        """Errors of the methods of others on a split."""
        return {
            method: self.errors[name, split, method]
            for method in METHODS
            if (name, split, method) in self.errors and "pisigma" not in method_of(method).packages
        }


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a table of Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
