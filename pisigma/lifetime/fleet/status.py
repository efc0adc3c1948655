"""Status of a fleet, which is a folder of cells: cells that need attention, and the largest errors."""

import datetime
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pisigma.files.errors import PisigmaError
from pisigma.lifetime.cell.history import Check
from pisigma.lifetime.cell.layout import cells_in
from pisigma.lifetime.cell.status import CellStatus, status_of
from pisigma.lifetime.cell.step import ATTENTION

UNREADABLE = "unreadable"
"""State of a cell whose file or history cannot be read."""


@dataclass(frozen=True)
class FleetStatus:
    """Status of a fleet.

    Attributes:
        folder: folder of the cells.
        cells: status of every cell that can be read, sorted by name.
        unreadable: reasons, by name of the cell, why the status of other cells cannot be read.
    """

    folder: Path
    cells: tuple[CellStatus, ...]
    unreadable: Mapping[str, str]

    @staticmethod
    def read(folder: str | os.PathLike[str]) -> "FleetStatus":
        """Read the status of all cells in a folder.

        Raises:
            PlanningError: the folder contains no cell.
        """
        cells, unreadable = list[CellStatus](), dict[str, str]()
        for cell in cells_in(folder):
            try:
                cells.append(status_of(cell))
            except PisigmaError as problem:  # an unreadable cell must not hide the others
                unreadable[cell.name] = str(problem)
        return FleetStatus(Path(folder), tuple(cells), unreadable)

    @cached_property
    def states(self) -> dict[str, tuple[str, ...]]:
        """Names of the cells in every state; states that need attention come first."""
        states: dict[str, tuple[str, ...]] = {UNREADABLE: tuple(self.unreadable)} if self.unreadable else {}
        for one in sorted(self.cells, key=urgency):
            states[one.step.state] = (*states.get(one.step.state, ()), one.name)
        return states

    @cached_property
    def sorted_by_error(self) -> tuple[tuple[CellStatus, Check], ...]:
        """Cells with a known error, and the check that determined it, largest RMS error first."""
        known = [(one, check) for one in self.cells if (check := one.last_error) is not None]
        return tuple(sorted(known, key=lambda one: -(one[1].rms_mm or 0.0)))

    @property
    def needs_action(self) -> bool:
        """Whether a cell needs attention, has steps that `pisigma fleet run` carries out, or cannot be read."""
        return bool(self.unreadable) or any(
            one.step.state in ATTENTION or one.has_automatic_step for one in self.cells
        )

    def to_json(self) -> dict[str, Any]:
        """Return all figures as plain values."""
        return {
            "today": datetime.date.today().isoformat(),
            "states": {state: list(cells) for state, cells in self.states.items()},
            "largest_errors": [
                {"cell": one.name, "rms_mm": check.rms_mm, "command": check.command}
                for one, check in self.sorted_by_error
            ],
            "unreadable": [{"cell": name, "reason": reason} for name, reason in self.unreadable.items()],
            "cells": [one.to_json() for one in self.cells],
        }


def urgency(status: CellStatus) -> tuple[int, str]:
    """Return a sort key: first cells that need attention, then cells with steps that can be carried out."""
    state = status.step.state
    if state in ATTENTION:
        return ATTENTION.index(state), state
    return len(ATTENTION) + (0 if status.has_automatic_step else 2 if state == "up_to_date" else 1), state
