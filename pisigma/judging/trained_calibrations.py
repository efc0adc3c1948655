"""Calibrations that are judged side by side, trained on the same rows."""

from collections.abc import Callable
from dataclasses import replace

from pisigma.hybrid.calibrator import HybridCalibrator
from pisigma.hybrid.result import HybridResult
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.identification.problem.loss import SquaredLoss
from pisigma.identification.result import CalibrationResult
from pisigma.measurement.dataset import Measurements

Calibrator = GeometricCalibrator | HybridCalibrator
Result = CalibrationResult | HybridResult


def geometric_of(calibrator: Calibrator) -> GeometricCalibrator:
    """The geometric calibrator, or the one that a hybrid builds upon."""
    return calibrator.geometric if isinstance(calibrator, HybridCalibrator) else calibrator


def geometric_result(result: Result) -> CalibrationResult:
    """The geometric calibration, or the one that a hybrid builds upon."""
    return result.geometric if isinstance(result, HybridResult) else result


def fit(calibrator: Calibrator, rows: Measurements, progress: Callable[[str], None]) -> Result:
    """Calibrate; see the calibrators' `fit`.

    Args:
        calibrator: of either kind.
        rows: to calibrate with.
        progress: called with what a hybrid tries.
    """
    return (
        calibrator.fit(rows, progress) if isinstance(calibrator, HybridCalibrator) else calibrator.fit(rows)
    )


def trained(
    calibrator: Calibrator,
    rows: Measurements,
    progress: Callable[[str], None] = lambda what: None,
    known: Result | None = None,
) -> dict[str, Result]:
    """The calibrations of some rows that are compared, by name.

    Args:
        calibrator: of either kind.
        rows: to calibrate with.
        progress: called with what is being tried.
        known: what the calibrator gave for these rows, where that is known already.

    Returns:
        "nominal": the arm as drawn, base and tool fitted and every row counted in full; "geometric"; and "hybrid"
        of a hybrid calibrator.

    Raises:
        IdentificationError: the rows do not determine what is asked for.
    """
    found: dict[str, Result] = {"nominal": base_and_tool(geometric_of(calibrator)).fit(rows)}
    result = fit(calibrator, rows, progress) if known is None else known
    found["geometric"] = geometric_result(result)
    return found | ({"hybrid": result} if isinstance(result, HybridResult) else {})


def base_and_tool(calibrator: GeometricCalibrator) -> GeometricCalibrator:
    """The arm as drawn; only base and tool are fitted, and every row counts in full."""
    return replace(calibrator, free=(), loss=SquaredLoss())


def without_missing(calibrator: Calibrator, rows: Measurements, of: Measurements) -> Calibrator:
    """The calibrator without what it knows of frames and sockets that some of the rows lack.

    Args:
        calibrator: for all rows.
        rows: which it is to be given.
        of: all rows; what these lack too stays, so that the calibrator complains of it.
    """
    if isinstance(calibrator, HybridCalibrator):
        geometric = without_missing(calibrator.geometric, rows, of)
        assert isinstance(geometric, GeometricCalibrator)
        return replace(calibrator, geometric=geometric)
    no_frame = set(of.frame) - set(rows.frame)
    no_socket = (set(of.socket or ()) - set(rows.socket or ())) - {""}
    return replace(
        calibrator,
        frames={name: base for name, base in calibrator.frames.items() if name not in no_frame},
        socket_distances={
            pair: known for pair, known in calibrator.socket_distances.items() if not no_socket & set(pair)
        },
    )
