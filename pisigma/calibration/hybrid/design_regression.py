"""Bayesian linear regression of measured values on the unknowns of a design."""

import math
from abc import abstractmethod
from collections.abc import Sequence

from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.hybrid.design import Design
from pisigma.estimation.left_out import LeftOut
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
        """The same for the unknowns of a design that has some of the features, or smaller ones."""

    @abstractmethod
    def without(self, groups: Int64[Tensor, " groups"]) -> "AbstractDesignRegression":
        """The same without the values of some groups of rows, see `Rows.group`; values that are certain stay."""

    @abstractmethod
    def left_out(self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]]) -> LeftOut:
        """Leave out one fold after the other and predict it, with the prior sizes and the noise of a posterior.

        Args:
            posterior: of all values.
            folds: groups that are left out together, see `Rows.group`.
        """

    def left_out_anew(
        self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]], updates: int
    ) -> LeftOut:
        """The same with so many updates of noise and prior sizes for every fold: few rows leave these uncertain."""
        parts = []
        for groups in folds:
            rest = self.without(groups).maximise_evidence(posterior.prior, posterior.noise, updates)
            parts.append(self.left_out(rest, [groups]))
        return LeftOut.joined(parts)

    def first_sizes(
        self, posterior: Posterior, design: Design, features: AbstractFeature
    ) -> tuple[float, Float64[Tensor, " groups"] | None]:
        """By how much more features raise the log evidence with all other prior sizes and the noise fixed.

        Args:
            posterior: without them.
            design: without them.
            features: that are added.

        Returns:
            The gain, infinite where a fit says it as quickly; and the prior sizes of the features, to start from.
        """
        return math.inf, None
