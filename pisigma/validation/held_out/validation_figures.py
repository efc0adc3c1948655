"""Error statistics of held-out rows as typed values, in millimetres and degrees."""

from typing import Annotated

from pydantic import Field

from pisigma.files.yaml_file import Section, StoredFigures

MODELS = ("nominal", "geometric", "hybrid")
"""Calibrations that are compared, in the order of the tables."""


class ErrorFigures(Section):
    """Root mean square, mean, 95 % quantile and maximum of errors of position [mm] and orientation [deg]."""

    rms_mm: float | None = None
    mean_mm: float | None = None
    p95_mm: float | None = None
    max_mm: float | None = None
    rms_deg: float | None = None
    mean_deg: float | None = None
    p95_deg: float | None = None
    max_deg: float | None = None

    @property
    def figures_by_name(self) -> dict[str, float]:
        """Figures that are set, by name."""
        return self.model_dump(exclude_unset=True)


class DistanceFigures(Section):
    """Mean and maximum of the errors of distances between sockets [mm]."""

    mean_mm: float
    max_mm: float


class StatedDistance(Section):
    """A stated distance between two sockets [mm], and its errors under calibrations that do not use it [mm].

    Errors are predicted minus stated distances, averaged over several repeats of a cross-validation.
    """

    sockets: tuple[str, str]
    stated_mm: float
    errors_mm: dict[str, float]


class SocketDistances(Section):
    """Errors of `count` stated distances between sockets under calibrations that do not use them.

    Attributes:
        each: the individual distances.
    """

    count: int
    each: tuple[StatedDistance, ...] = ()
    nominal: DistanceFigures | None = None
    geometric: DistanceFigures | None = None
    hybrid: DistanceFigures | None = None

    @property
    def models(self) -> dict[str, DistanceFigures]:
        """Figures of the calibrations that have any, by name."""
        return {name: figures for name in MODELS if (figures := getattr(self, name)) is not None}


class AbstractValidationFigures(StoredFigures):
    """Errors of held-out rows under several calibrations.

    Attributes:
        folds: number of folds of the cross-validation; 1 if rows were held out once; not set for a test set.
        repeats: number of repeats of the cross-validation, if more than one.
        rms_mm_of_repeats: RMS position error of each repeat by calibration [mm].
        nominal: errors of the nominal robot, with base and tool fitted to the training rows.
        geometric: errors of the geometric calibration.
        hybrid: errors of geometry and joint correction.
        coverage: share of the held-out coordinates within the 95 % intervals that the hybrid predicts.
        predicted_rms_mm: RMS of the position errors that the hybrid predicts [mm].
        socket_distance: errors of stated distances between sockets that were held out.
        frames_held_out: number of frames that were held out completely; their bases were fitted to the held-out rows.
        sockets_held_out: number of sockets that were held out completely.
        rows_not_judged: number of held-out rows that could not be evaluated, because no training row has their target
            or anchor.
    """

    folds: int | None = None
    repeats: int | None = None
    rms_mm_of_repeats: dict[str, tuple[float, ...]] | None = None
    nominal: ErrorFigures | None = None
    geometric: ErrorFigures | None = None
    hybrid: ErrorFigures | None = None
    coverage: float | None = None
    predicted_rms_mm: float | None = None
    socket_distance: SocketDistances | None = None
    frames_held_out: Annotated[int | None, Field(alias="frames_fitted")] = None
    sockets_held_out: int | None = None
    rows_not_judged: int | None = None

    @property
    def models(self) -> dict[str, ErrorFigures]:
        """Figures of the evaluated calibrations, by name."""
        return {name: figures for name in MODELS if (figures := getattr(self, name)) is not None}


class ValidationFigures(AbstractValidationFigures):
    """Errors of held-out rows under several calibrations, also of simulations; see `AbstractValidationFigures`.

    Attributes:
        rows: number of held-out rows with a length, counted once for all repeats.
        rms_mm_of_simulations: RMS position error in each of several simulations by calibration [mm].
        mean_rms_mm: mean of `rms_mm_of_simulations` by calibration [mm].
    """

    rows: int
    rms_mm_of_simulations: dict[str, tuple[float, ...]] | None = None
    mean_rms_mm: dict[str, float] | None = None


class LearningPoint(AbstractValidationFigures):
    """Errors of `held_out` held-out rows under calibrations fitted to `rows` training rows."""

    rows: int
    held_out: int
