"""Typed figures of a fleet prior, from which its card, tables and JSON are made."""

import math
from collections.abc import Sequence
from typing import Annotated

import torch
from jaxtyping import Bool, Float64
from pydantic import Field
from torch import Tensor

from pisigma.files.yaml_file import StoredFigures
from pisigma.lifetime.fleet.prior import FleetPrior
from pisigma.measurement.sensors.sensor import SHOWN_UNITS
from pisigma.model.model_posterior import FLEET_PRIOR
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian
from pisigma.validation.held_out.summary import AbstractSummary

_SAME = 1e-6
"""Largest difference of the effects of parameters, relative to their sizes, that is due to rounding."""


class ParameterErrorFigures(StoredFigures):
    """Distribution of a parameter's error in the fleet.

    Attributes:
        name: name such as "theta_1".
        unit: "mm" or "deg".
        mean: mean error.
        sigma: standard deviation between robots.
        is_determined_only_in_sum: whether other parameters, base or tool move the tool of the nominal
            robot in the same way, so that mean and deviation are determined only together with theirs.
    """

    name: str
    unit: str
    mean: float
    sigma: Annotated[float, Field(alias="deviation")]
    is_determined_only_in_sum: Annotated[bool, Field(alias="in_a_sum")] = False


class WeightSpreadFigures(StoredFigures):
    """Standard deviation between robots of the weights of a feature.

    Attributes:
        group: name of the group, such as "harmonics 1 to 1".
        sigma_deg: root mean square over the weights of the group [deg; lengths are divided by the reach].
    """

    group: str
    sigma_deg: Annotated[float, Field(alias="deg")]


class FleetPriorSummary(AbstractSummary):
    """All figures of a fleet prior.

    Attributes:
        robots: number of robots that were used.
        inconsistent_robots: ids of robots that were not used because they are inconsistent with the other robots.
        refused: reasons, by id of the robot, why files cannot be read.
        remarks: remarks on the rows of the robots that were used, one sentence each.
        rows: number of rows of all robots.
        parameters: distributions of the geometric parameters.
        spectrum: standard deviations of the joint correction's weights.
    """

    kinds = (FLEET_PRIOR,)

    robots: int
    inconsistent_robots: Annotated[tuple[str, ...], Field(alias="odd")]
    refused: dict[str, str] = Field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    rows: int
    parameters: tuple[ParameterErrorFigures, ...]
    spectrum: tuple[WeightSpreadFigures, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings, one sentence each."""
        odd = (
            f"Robot '{name}' is inconsistent with the others and was not used."
            for name in self.inconsistent_robots
        )
        refused = (f"Robot '{name}' was not used: {reason}" for name, reason in self.refused.items())
        return (*odd, *refused, *self.remarks)


def summarise_prior(prior: FleetPrior, ids: Sequence[str]) -> FleetPriorSummary:
    """Collect all figures of a fleet prior.

    Args:
        prior: the prior.
        ids: ids of the robots.
    """
    population, uncertainty = prior.population, prior.model.uncertainty
    assert uncertainty is not None
    deviation = population.covariance.diagonal().sqrt()
    in_a_sum = _dependent_columns(uncertainty.space.robot, prior.model.starts)
    parameters = []
    for number, name in enumerate(prior.names):
        unit, scale = SHOWN_UNITS[uncertainty.space.parameters[number].unit]
        mean, spread = float(population.mean[number]) * scale, float(deviation[number]) * scale
        dependent = bool(in_a_sum[number])
        parameters.append(
            ParameterErrorFigures(
                name=name, unit=unit, mean=mean, sigma=spread, is_determined_only_in_sum=dependent
            )
        )
    weights, start, spectrum = deviation[population.geometric_count :], 0, []
    for feature in uncertainty.features:
        group = feature.group[feature.used]
        chosen = weights[start : start + len(group)]
        start += len(group)
        for number, what in enumerate(feature.group_names):
            size = float(chosen[group == number].square().mean().sqrt())
            spectrum.append(
                WeightSpreadFigures(group=f"{feature.name}: {what}", sigma_deg=math.degrees(size))
            )
    return FleetPriorSummary(
        robots=len(ids) - len(prior.inconsistent_robots),
        inconsistent_robots=tuple(ids[number] for number in prior.inconsistent_robots),
        rows=prior.model.provenance.rows,
        parameters=tuple(parameters),
        spectrum=tuple(spectrum),
    )


def _dependent_columns(robot: Robot, q: Float64[Tensor, "poses dof"]) -> Bool[Tensor, " parameters"]:
    """Return the mask of the parameters of arm, base and tool whose effect on poses is that of other parameters."""
    J = identification_jacobian(robot, q)[1].flatten(0, 1)
    J = J / torch.linalg.vector_norm(J, dim=0).clamp(min=1e-300)
    _, sizes, directions = torch.linalg.svd(J)
    null = directions[int((sizes > _SAME * sizes[0]).sum()) :]
    dependent: Tensor = torch.linalg.vector_norm(null, dim=0) > _SAME
    return dependent
