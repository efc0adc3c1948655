"""What every check of a calibration has in common."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.validation.held_out.calibration_validation import CalibrationValidation, errors_under
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.trained_calibrations import Result, geometric_result
from pisigma.validation.held_out.validation_figures import ValidationFigures


@dataclass(frozen=True, eq=False)
class CheckedCalibration:
    """A calibration with all that a check may look at.

    Attributes:
        calibrator: what gave the geometric calibration; fits others to the same rows.
        rows: that were calibrated with, as read; `rows.place(row)` names file and line.
        results: by name, all fitted to these rows: "nominal" (the arm as drawn, base and tool fitted, every row
            counted in full), "geometric", and "hybrid" where it was asked for.
        validation: errors of held-out rows; None without any.
    """

    calibrator: GeometricCalibrator
    rows: Measurements
    results: Mapping[str, Result]
    validation: CalibrationValidation | None = None

    @property
    def robot(self) -> Robot:
        """The robot as drawn."""
        return self.calibrator.robot

    @property
    def nominal(self) -> CalibrationResult:
        """The arm as drawn, with base and tool fitted."""
        return geometric_result(self.results["nominal"])

    @property
    def geometric(self) -> CalibrationResult:
        """The geometric calibration, or the one that the hybrid builds upon."""
        return geometric_result(self.results["geometric"])

    @property
    def hybrid(self) -> HybridResult | None:
        """The hybrid calibration; None where only a geometric one was asked for."""
        result = self.results.get("hybrid")
        return result if isinstance(result, HybridResult) else None

    @cached_property
    def errors(self) -> Mapping[str, Mapping[str, Float64[Tensor, "rows components"]]]:
        """By name of the result and by sensor, measured - predicted of every row [m or rad].

        Rows are in the order of `rows`; NaN where the sensor measured nothing.
        """
        return MappingProxyType({name: result.errors_of(self.rows) for name, result in self.results.items()})

    @property
    def final_errors(self) -> Mapping[str, Float64[Tensor, "rows components"]]:
        """The same by sensor of the calibration that is kept: the last one."""
        return list(self.errors.values())[-1]

    @cached_property
    def figures(self) -> ValidationFigures | None:
        """Errors of the rows that were calibrated with, under every calibration; None where no length was measured."""
        errors = {name: errors_under(result, self.rows) for name, result in self.results.items()}
        if not any(bool(torch.isfinite(one.position).any()) for one in errors.values()):
            return None
        return ValidationFigures(rows=self.rows.rows, **{name: one.figures for name, one in errors.items()})


class AbstractCheck(ABC):
    """Looks for one kind of fault in a calibration."""

    @abstractmethod
    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """Say what is wrong; nothing where nothing is.

        Raises:
            IdentificationError: the measurements cannot be of this robot at all, so that they are refused.
        """
