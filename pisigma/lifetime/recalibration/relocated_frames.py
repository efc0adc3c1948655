"""Find the bases and tools that have been moved since a model was made, by the evidence of new rows."""

from collections.abc import Set
from contextlib import suppress

from pisigma.calibration.geometric.initial_guess.initial_guess import randomly_chosen_rows
from pisigma.estimation.drift import LOG_PRIOR_PENALTY
from pisigma.files.errors import IdentificationError
from pisigma.lifetime.recalibration.adaptation import adapt
from pisigma.lifetime.recalibration.recalibration_problem import FrameKey, known_frames, recalibration_problem
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_posterior import ModelPosterior

_MAX_ROWS = 30
"""Largest number of rows that are used for the decision."""
MIN_MOVE = 1e-3
"""Size of the drift [m, or share of the reach] below which a base or a tool is treated as not moved."""


def relocated_frames(
    model: CalibratedModel, posterior: ModelPosterior, rows: Measurements
) -> frozenset[FrameKey]:
    """Find the bases and tools of a model that were moved.

    Under each hypothesis, joints, geometry and correction may drift, and the base, the tool, both or neither have a
    wide prior around a closed-form guess. The hypothesis with the largest evidence is chosen.

    Args:
        model: the model.
        posterior: posterior of the model.
        rows: new rows, frames and targets by the names of the model.

    Returns:
        The bases and tools that were moved, without frames and targets that the model lacks.

    Raises:
        IdentificationError: see `recalibration_problem`.
    """
    if rows.rows > _MAX_ROWS and rows.pair is None:
        rows = rows.select(randomly_chosen_rows(rows.rows, _MAX_ROWS).sort().values)
    bases, tools = known_frames(posterior, rows)

    def evidence(relocated: Set[FrameKey]) -> float:
        problem = recalibration_problem(model, posterior, rows, relocated)
        return adapt(problem).drift.log_evidence - LOG_PRIOR_PENALTY * len(relocated)

    unmoved = adapt(recalibration_problem(model, posterior, rows, frozenset())).drift
    if all(
        group.drift_size < MIN_MOVE for group in unmoved.groups if group.name.startswith(("base", "tool"))
    ):
        return frozenset()
    tried = {frozenset[FrameKey](): unmoved.log_evidence}
    for owners in filter(None, (bases, tools, bases | tools)):
        with suppress(IdentificationError):  # too few rows to determine these
            tried[owners] = evidence(owners)
    return max(tried, key=lambda owners: tried[owners])
