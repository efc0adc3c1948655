"""Interface of the checks of a calibration, and the calibration as they see it."""

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
    """A calibration, its rows, and everything else that a check may need.

    Attributes:
        calibrator: the calibrator of the geometric calibration; checks also fit others to the same rows with it.
        rows: the rows of the calibration, as read; `rows.place(row)` names file and line.
        results: by name, all fitted to these rows: "nominal" (the nominal arm with base and tool fitted, all rows with
            full weight), "geometric", and "hybrid" if one was requested.
        validation: errors of held-out rows; None if no rows were held out.
    """

    calibrator: GeometricCalibrator
    rows: Measurements
    results: Mapping[str, Result]
    validation: CalibrationValidation | None = None

    @property
    def robot(self) -> Robot:
        """The nominal robot."""
        return self.calibrator.robot

    @property
    def nominal(self) -> CalibrationResult:
        """The nominal arm with base and tool fitted."""
        return geometric_result(self.results["nominal"])

    @property
    def geometric(self) -> CalibrationResult:
        """The geometric calibration, or the one that the hybrid is based on."""
        return geometric_result(self.results["geometric"])

    @property
    def hybrid(self) -> HybridResult | None:
        """The hybrid calibration; None if only a geometric one was requested."""
        result = self.results.get("hybrid")
        return result if isinstance(result, HybridResult) else None

    @cached_property
    def errors(self) -> Mapping[str, Mapping[str, Float64[Tensor, "rows components"]]]:
        """Errors, measured minus predicted, by result and sensor [m or rad].

        Rows are in the order of `rows`; NaN where the sensor has no value.
        """
        return MappingProxyType({name: result.errors_of(self.rows) for name, result in self.results.items()})

    @property
    def final_errors(self) -> Mapping[str, Float64[Tensor, "rows components"]]:
        """Errors of the last result by sensor, which is the calibration that is kept [m or rad]."""
        return list(self.errors.values())[-1]

    @cached_property
    def figures(self) -> ValidationFigures | None:
        """Errors of the rows of the calibration under every result; None if no length was measured."""
        errors = {name: errors_under(result, self.rows) for name, result in self.results.items()}
        if not any(bool(torch.isfinite(one.position).any()) for one in errors.values()):
            return None
        return ValidationFigures(rows=self.rows.rows, **{name: one.figures for name, one in errors.items()})


class AbstractCheck(ABC):
    """A check of a calibration for one kind of fault."""

    @abstractmethod
    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """Report faults; yield nothing if none is found.

        Raises:
            IdentificationError: the measurements cannot belong to this robot and are refused.
        """
