"""Whether bases and tools stand elsewhere than when a model was made, by the evidence of new rows."""

from collections.abc import Mapping, Set
from contextlib import suppress

from pisigma.calibration.geometric.initial_guess.initial_guess import chosen_rows
from pisigma.estimation.drift import LOG_PRIOR_PENALTY
from pisigma.files.errors import IdentificationError
from pisigma.lifetime.recalibration.adaptation import adapt
from pisigma.lifetime.recalibration.recalibration_problem import FrameKey, recalibration_problem
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, Frames
from pisigma.model.model_posterior import ModelPosterior

MOST_ROWS = 30
"""Rows that the question is decided on."""
FAR = 1e-3
"""[m, or of the reach] A base or a tool that drifted by less is where it was, but for the drift."""


def relocated_frames(
    model: CalibratedModel, posterior: ModelPosterior, rows: Measurements, noise: Mapping[str, float]
) -> frozenset[FrameKey]:
    """Find which of the bases and tools that a model has stand elsewhere.

    Each hypothesis lets joints, geometry and correction drift; it has the evidence of the rows with the base, the tool,
    both or none anywhere about a guess in closed form.

    Args:
        model: the model.
        posterior: of it.
        rows: new ones, frames and targets by the names of the model.
        noise: of the calibration, per sensor.

    Returns:
        Those that stand elsewhere; frames and targets that the model does not have are not among them.

    Raises:
        IdentificationError: see `recalibration_problem`.
    """
    if rows.rows > MOST_ROWS and rows.pair is None:
        rows = rows.select(chosen_rows(rows.rows, MOST_ROWS).sort().values)
    bases, tools = (
        frozenset((kind, name) for name in dict.fromkeys(names) if name in frames)
        for kind, names, frames in _kinds(rows, posterior)
    )

    def evidence(elsewhere: Set[FrameKey]) -> float:
        problem = recalibration_problem(model, posterior, rows, elsewhere)
        return adapt(problem, noise).drift.log_evidence - LOG_PRIOR_PENALTY * len(elsewhere)

    still = adapt(recalibration_problem(model, posterior, rows, frozenset()), noise).drift
    if all(group.size < FAR for group in still.groups if group.what.startswith(("base", "tool"))):
        return frozenset()
    tried = {frozenset[FrameKey](): still.log_evidence}
    with suppress(IdentificationError):  # so few rows cannot say where these stand
        tried |= {owners: evidence(owners) for owners in (bases, tools, bases | tools) if owners}
    return max(tried, key=lambda owners: tried[owners])


def _kinds(
    rows: Measurements, posterior: ModelPosterior
) -> tuple[tuple[str, tuple[str, ...], Frames], tuple[str, tuple[str, ...], Frames]]:
    geometry = posterior.geometry
    return ("base", rows.frame, geometry.bases), ("tool", rows.target, geometry.tools)
