"""Predicted accuracy of the positions of a model."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.calibration.geometric.posterior import ParameterPosterior
from pisigma.measurement.conditions import CONDITIONS
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, model_names_of_rows
from pisigma.model.stated_conditions import mean_conditions


def position_accuracy(
    model: CalibratedModel,
    q: Float[Tensor, "*batch dof"],
    approach: Float64[np.ndarray, "*batch dof"] | None = None,
) -> Float64[Tensor, "*batch"]:
    """Compute the standard deviation of the tool's predicted position [m], `sqrt(σx² + σy² + σz²)`.

    Args:
        model: calibrated model; the position is that of its first target in its first frame.
        q: commanded joint values [rad or m].
        approach: +1 or -1 for the direction of approach of every joint, 0 if it is unknown; None if unknown for all
            joints.

    Returns:
        The standard deviation of every pose; NaN where a joint value is NaN, and everywhere if the model has no
        uncertainty.
    """
    flat = q.detach().to("cpu", torch.float64).reshape(-1, q.shape[-1])
    result = torch.full((len(flat),), torch.nan, dtype=torch.float64)
    rows = torch.isfinite(flat).all(-1).nonzero()[:, 0]
    if model.uncertainty is not None and len(rows):
        frame, target = (next(iter(known), "") for known in (model.bases, model.tools))
        usual = mean_conditions(model) | model.conditions
        payload, temperature = (
            torch.full((len(rows),), usual.get(name, torch.nan), dtype=torch.float64) for name in CONDITIONS
        )
        sides = None
        if approach is not None:
            stated = torch.tensor(np.where(approach == 0, np.nan, approach)).expand(q.shape)
            sides = stated.reshape(flat.shape)[rows]
        at = Measurements(
            q=flat[rows],
            frame=(frame,) * len(rows),
            target=(target,) * len(rows),
            payload=payload,
            temperature=temperature,
            approach=sides,
        )
        result[rows] = sigma_of_rows(model, at).norm(dim=-1)
    return result.reshape(q.shape[:-1])


def sigma_of_rows(model: CalibratedModel, measurements: Measurements) -> Float64[Tensor, "rows 3"]:
    """Compute the standard deviation of every row's target position along the axes of its frame [m].

    It includes the posterior and the effect of conditions that the rows do not state, such as directions of approach,
    but no measurement noise, both inside and outside the measured joint values.

    Returns:
        The standard deviations; NaN if the model has no uncertainty.

    Raises:
        MeasurementError: the model was not calibrated for a frame or target of the rows.
    """
    if model.uncertainty is None:
        return torch.full((measurements.rows, 3), torch.nan, dtype=torch.float64)
    frame = model_names_of_rows(model.bases, measurements.frame, "frame", measurements)
    target = model_names_of_rows(model.tools, measurements.target, "target", measurements)
    at, arm = replace(measurements, frame=frame, target=target), model.hybrid
    return model.uncertainty.sigma(
        at, model.condition_correction or (None if arm is None else arm.correction)
    )


def parameter_posterior(model: CalibratedModel) -> ParameterPosterior | None:
    """Return the joint posterior of all geometric parameters, in the user's coordinates.

    Returns:
        Geometry, bases, tools and unknown sensor parameters with all their correlations, including those with the
        weights of the joint correction; None if the model has no uncertainty.
    """
    known = model.uncertainty
    return (
        None
        if known is None
        else ParameterPosterior.from_geometry(known.space, known.geometry, known.dense_root)
    )
