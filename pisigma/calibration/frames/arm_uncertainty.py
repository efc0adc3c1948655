"""Errors of predicted values due to the uncertainty of a model's arm, joint correction and other fixed unknowns."""

from collections.abc import Collection
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.whitened_values import WhitenedValues
from pisigma.calibration.geometric.problem.parameters import Parameter
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements


@dataclass(frozen=True, eq=False)
class ArmUncertainty:
    """Uncertainty of a model, for fits of frames that hold its arm fixed.

    Attributes:
        uncertainty: the posterior of the model.
        rows: rows of the fit, with commanded joint values.
    """

    uncertainty: PositionUncertainty
    rows: Measurements

    def value_covariance_root(
        self, solved: SolvedCalibration, used_rows: Collection[int], fitted_parameters: Collection[int]
    ) -> Float64[Tensor, "values directions"]:
        """Return a root of the covariance of the measured values, in standard deviations of their noise.

        Args:
            solved: fit of some rows.
            used_rows: indices of these rows.
            fitted_parameters: indices of the fitted parameters, whose uncertainty in the model does not matter.
        """
        root, fit_space = self.uncertainty.dense_root, solved.problem.space
        positions = indices_by_key(self.uncertainty.space.parameters)
        pairs = [
            (index, positions[key])
            for key, index in indices_by_key(fit_space.parameters).items()
            if index not in fitted_parameters and key in positions
        ]
        values = WhitenedValues.at_solution(solved, [index for index, _ in pairs])
        rows = self.rows.select(torch.tensor(list(used_rows))).select(solved.setup.row_indices)
        weights = values.weight_columns(self.uncertainty.features, JointState.from_measurements(rows))
        parameters = len(self.uncertainty.space.parameters)
        of_parameters = values.X @ root[[number for _, number in pairs]]
        spread: Tensor = of_parameters + weights @ root[parameters:]
        return spread


def indices_by_key(parameters: tuple[Parameter, ...]) -> dict[tuple[str, str, str], int]:
    """Return the position of every parameter by group, owner and column, a key that does not depend on other owners."""
    return {
        (one.group, one.owner, one.name.rsplit("_", 1)[-1]): number for number, one in enumerate(parameters)
    }
