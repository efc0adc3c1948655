"""Bayesian linear regression of measured values on the unknowns of a design."""

import math
from abc import abstractmethod
from collections.abc import Sequence

from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.hybrid.design import Design
from pisigma.estimation.held_out import HeldOutErrors
from pisigma.estimation.regression import AbstractRegression, Posterior
from pisigma.joint_correction.feature import AbstractFeature


class AbstractDesignRegression(AbstractRegression):
    """Weighted linear regression `y = X x + e` of all measured values on the unknowns.

    Attributes:
        design: the unknowns.
    """

    design: Design

    @abstractmethod
    def select(self, design: Design) -> "AbstractDesignRegression":
        """Return the regression for a design with some of the features, or smaller ones."""

    @abstractmethod
    def without_groups(self, groups: Int64[Tensor, " groups"]) -> "AbstractDesignRegression":
        """Return the regression without the values of some groups of rows (see `Rows.group`), except certain ones."""

    @abstractmethod
    def held_out_errors(
        self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]]
    ) -> HeldOutErrors:
        """Leave out each fold and predict it, with the prior sizes and the noise of a posterior.

        Args:
            posterior: posterior by all values.
            folds: groups that are held out together, see `Rows.group`.
        """

    def held_out_errors_refitted(
        self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]], updates: int
    ) -> HeldOutErrors:
        """Leave out each fold, with updates of noise and prior sizes, which few rows leave uncertain."""
        parts = []
        for groups in folds:
            rest = self.without_groups(groups).maximise_evidence(posterior.prior, posterior.noise, updates)
            parts.append(self.held_out_errors(rest, [groups]))
        return HeldOutErrors.joined(parts)

    def initial_prior_sizes(
        self, posterior: Posterior, design: Design, features: AbstractFeature
    ) -> tuple[float, Float64[Tensor, " groups"] | None]:
        """Compute the gain of log evidence by additional features, with all other prior sizes and the noise fixed.

        Args:
            posterior: posterior without the features.
            design: design without the features.
            features: the additional features.

        Returns:
            The gain, infinite if a fit is as fast; and start values of the prior sizes of the features.
        """
        return math.inf, None
