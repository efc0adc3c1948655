"""What is wrong with all rows of a session alike, as the gate for rows says it."""

from jaxtyping import Bool
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot
from pisigma.validation.checks.rows.mixed_rows import MOST_WRONG
from pisigma.validation.checks.rows.row_check import MOVES
from pisigma.validation.gate import check_rows


def setup_sentence(
    rows: Measurements, counts: Bool[Tensor, " rows"], against: Robot | CalibratedModel
) -> str:
    """Say what the rows have in common that is wrong; "" where nothing is.

    Where a quarter of the rows or more contradict the others, all of them are judged together.

    Args:
        rows: all rows that are no copies.
        counts: those that others do not contradict.
        against: the robot as drawn, or the model that was planned for.
    """
    some = rows.select(counts) if counts.double().mean() > 1 - MOST_WRONG else rows
    found = check_rows(some, against, may_move=MOVES).implausible
    return found[0].sentence if found else ""
