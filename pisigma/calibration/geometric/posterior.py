"""Joint posterior of all parameters of a calibration: values and covariance."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import Parameter, ParameterSpace
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.files.errors import IdentificationError, choice_remedy


@dataclass(frozen=True, eq=False)
class ParameterPosterior:
    """Posterior normal distribution of all parameters, in the user's coordinates.

    The parameters are the geometry, the bases of all frames, the tools of all targets, and the unknowns of the sensors
    (sockets, anchors, zeros) in the frame of their owner.

    Attributes:
        parameters: the parameters in order, with names and units.
        mean: values of the parameters [m or rad]; NaN if a model of an earlier version does not store a value.
        covariance_root: root `R` of the covariance `R R^T` [m and rad] of all parameters (0 for parameters that were
            not free), followed by the weights of a joint correction, if any, which have no names.
    """

    parameters: tuple[Parameter, ...]
    mean: Float64[Tensor, " parameters"]
    covariance_root: Float64[Tensor, "unknowns directions"]

    @staticmethod
    def from_geometry(
        space: ParameterSpace,
        geometry: IdentifiedGeometry,
        covariance_root: Float64[Tensor, "unknowns directions"],
    ) -> "ParameterPosterior":
        """Return the posterior of the parameters of a space, with their values in the user's coordinates."""
        return ParameterPosterior(space.parameters, geometry.values_of(space), covariance_root)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, such as "theta_1", "base_x" or "socket_plate/0_x"."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def weight_count(self) -> int:
        """Number of weights of a joint correction, which follow the parameters in the covariance."""
        return len(self.covariance_root) - len(self.parameters)

    @cached_property
    def covariance(self) -> Float64[Tensor, "unknowns unknowns"]:
        """Covariance of all parameters, followed by all weights [m and rad]."""
        return self.covariance_root @ self.covariance_root.t()

    @property
    def standard_errors(self) -> Float64[Tensor, " parameters"]:
        """Standard deviation of every parameter [m or rad]; 0 for parameters that were not free."""
        errors: Tensor = torch.linalg.vector_norm(self.covariance_root[: len(self.parameters)], dim=1)
        return errors

    def select(self, names: Sequence[str]) -> "ParameterPosterior":
        """Return the marginal distribution of the named parameters.

        Raises:
            IdentificationError: there is no parameter with one of the names.
        """
        number = {name: index for index, name in enumerate(self.names)}
        for name in names:
            if name not in number:
                raise IdentificationError(
                    f"there is no parameter '{name}'", value=name, remedy=choice_remedy(name, self.names)
                )
        rows = [number[name] for name in names]
        return ParameterPosterior(
            tuple(self.parameters[row] for row in rows), self.mean[rows], self.covariance_root[rows]
        )
