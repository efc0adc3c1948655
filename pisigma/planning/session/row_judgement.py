"""Which rows count: each is judged by all others, and again when more are there."""

import contextlib
import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.planning.session.row_model import LeftOutRows, RowModel
from pisigma.robot.description import Robot

FALSE_ALARMS = 1e-3
"""Share of right rows that are expected to be called wrong."""
FEW_ROWS = 12
"""Up to so many, all of them are judged anew with every row, and each is tried as the wrong one."""
CONTRADICTORY = 2.0
"""Few rows whose errors are larger than those of the robot's class by this factor contradict each other."""
CLEARER = 8.0
"""An older row is blamed instead of a newer one where that explains the others better by so much misfit."""


@dataclass(frozen=True, eq=False)
class RowJudgement:
    """Which rows count.

    Attributes:
        counts: rows that others do not contradict.
        model: of the rows that count; None while they are too few for base and tool.
        errors: of all rows under it; None likewise.
    """

    counts: Bool[Tensor, " rows"]
    model: RowModel | None = None
    errors: LeftOutRows | None = None

    @property
    def judged(self) -> Bool[Tensor, " rows"]:
        """Rows of which the others say anything."""
        none = torch.zeros_like(self.counts)
        return none if self.errors is None else self.errors.chance.isfinite()


def judge_rows(
    robot: Robot, rows: Measurements, sigma: float | None, trusted: Bool[Tensor, " rows"]
) -> RowJudgement:
    """Judge rows by those that were right so far, and these by each other.

    Args:
        robot: as drawn.
        rows: all rows, the last ones new.
        sigma: see `RowModel.of`.
        trusted: rows that counted so far; of few rows none is trusted.
    """
    few = rows.rows <= FEW_ROWS
    counts = torch.ones_like(trusted) if few else trusted.clone()
    try:
        model = RowModel.of(robot, rows, sigma, counts)
        errors = model.left_out()
        while (wrong := _contradicted(robot, rows, sigma, model, errors, few)) is not None:
            model, errors = wrong
        right = ~(errors.chance < FALSE_ALARMS) & ~model.kept
        if bool(right.any()):
            model = RowModel.of(robot, rows, sigma, model.kept | right)
            again = model.left_out()
            errors = replace(again, chance=errors.chance)
        return RowJudgement(model.kept, model, errors)
    except IdentificationError:  # too few for base and tool
        return RowJudgement(torch.ones_like(trusted))


def _contradicted(
    robot: Robot, rows: Measurements, sigma: float | None, model: RowModel, errors: LeftOutRows, few: bool
) -> tuple[RowModel, LeftOutRows] | None:
    """Leave out the row among those that count that the others contradict; None where there is none.

    A wrong row among few moves base and tool so far that it cannot be told from the others but by leaving it out.
    """
    counts = model.kept
    chance = torch.where(counts, errors.chance, torch.nan)
    suspects = [int(chance.nan_to_num(nan=1.0).argmin())] if bool((chance < FALSE_ALARMS).any()) else []
    if few and (suspects or errors.scale > CONTRADICTORY):
        suspects = counts.nonzero()[:, 0].tolist()
    misfits: dict[int, float] = {}
    for row in suspects if len(suspects) > 1 else ():
        others = counts.clone()
        others[row] = False
        with contextlib.suppress(IdentificationError):
            every = torch.ones(int(others.sum()), dtype=torch.bool)
            misfits[row] = RowModel.of(robot, rows.select(others), sigma, every).misfit
    least = min(misfits.values(), default=0.0)
    likely = [row for row in suspects if misfits.get(row, math.inf) <= least + CLEARER] or suspects
    for row in likely[-1:]:
        others = counts.clone()
        others[row] = False
        model = RowModel.of(robot, rows, sigma, others)
        errors = model.left_out()
        if float(errors.chance[row]) < FALSE_ALARMS:
            return model, errors
    return None
