"""How the error on held-out rows falls with the number of training rows."""

from collections.abc import Sequence
from dataclasses import dataclass

from pisigma.judging.calibration_validation import CalibrationValidation, Progress, validate
from pisigma.judging.trained_calibrations import Calibrator
from pisigma.judging.validation_figures import LearningPoint
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import TrainTest, with_fewer


@dataclass(frozen=True, eq=False)
class CurvePoint:
    """What so many training rows give.

    Attributes:
        rows: to calibrate with.
        validation: errors of the held-out rows of all parts.
    """

    rows: int
    validation: CalibrationValidation

    def figures(self) -> LearningPoint:
        """The figures in mm and deg."""
        figures = self.validation.figures().model_dump(exclude_unset=True)
        return LearningPoint.model_validate({**figures, "rows": self.rows, "held_out": figures["rows"]})


def learning_curve(
    calibrator: Calibrator,
    measurements: Measurements,
    parts: Sequence[TrainTest],
    sizes: Sequence[int],
    seed: int,
    progress: Progress = lambda what: None,
    whole: CalibrationValidation | None = None,
) -> tuple[CurvePoint, ...]:
    """Calibrate with fewer and fewer of the training rows of every part and judge on all its test rows.

    Args:
        calibrator: see `validate`.
        measurements: the rows.
        parts: training and test rows.
        sizes: numbers of training rows.
        seed: decides which rows are drawn; smaller draws are part of larger ones.
        progress: called with what is being done.
        whole: what all training rows gave, as the last point of the curve; None for none.

    Returns:
        The points, fewest rows first.

    Raises:
        MeasurementError: a part has fewer training rows than are wanted.
        IdentificationError: so few rows do not determine what is asked for.
    """
    points = [
        CurvePoint(
            rows,
            validate(
                calibrator,
                measurements,
                with_fewer(measurements, parts, rows, seed),
                lambda what, rows=rows: progress(f"{rows} training rows: {what}"),  # type: ignore[misc]
            ),
        )
        for rows in sorted(sizes)
    ]
    if whole is not None:
        points.append(CurvePoint(min(len(train) for train, _ in parts), whole))
    return tuple(points)
