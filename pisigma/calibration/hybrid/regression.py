"""Which form of the regression is the cheaper one."""

from pisigma.calibration.hybrid.design import Design, Rows
from pisigma.calibration.hybrid.design_regression import AbstractDesignRegression
from pisigma.calibration.hybrid.normal_equations import NormalEquations
from pisigma.calibration.hybrid.value_covariance import ValueCovariance

MOST_VALUES = 1_000
"""The covariance of the values is used up to so many, whose matrices of all groups then take up to 200 MB."""


def regression(design: Design, rows: Rows) -> AbstractDesignRegression:
    """Normal equations, or the covariance of the values where there are few values and more unknowns."""
    values = sum(sensor.residual.numel() for sensor in rows.values)
    few = values <= min(MOST_VALUES, design.unknowns)
    return ValueCovariance.of(design, rows) if few else NormalEquations.of(design, rows)


def extended(before: AbstractDesignRegression, design: Design, rows: Rows) -> AbstractDesignRegression:
    """The regression of the same rows on a design that has some of the features, and a new one as its last."""
    return before.extended(design) if isinstance(before, NormalEquations) else regression(design, rows)
