"""Figures of held-out rows as typed values, in millimetres and degrees."""

from pisigma.files.yaml_file import Section

MODELS = ("nominal", "geometric", "hybrid")
"""Calibrations that are judged side by side, in the order of the tables."""


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
    def by_name(self) -> dict[str, float]:
        """The figures that there are, by name."""
        return self.model_dump(exclude_unset=True)


class DistanceFigures(Section):
    """Mean and maximum of the errors of distances between sockets [mm]."""

    mean_mm: float
    max_mm: float


class StatedDistance(Section):
    """A stated distance of two sockets [mm], and by calibration without it the predicted one minus it [mm].

    In several repeats of a cross-validation, the mean of these errors.
    """

    sockets: tuple[str, str]
    stated_mm: float
    errors_mm: dict[str, float]


class SocketDistances(Section):
    """Errors of stated distances of sockets under calibrations without them; `count` distances were left out in turn.

    Attributes:
        each: one by one.
    """

    count: int
    each: tuple[StatedDistance, ...] = ()
    nominal: DistanceFigures | None = None
    geometric: DistanceFigures | None = None
    hybrid: DistanceFigures | None = None

    @property
    def models(self) -> dict[str, DistanceFigures]:
        """The calibrations that there are, by name."""
        return {name: figures for name in MODELS if (figures := getattr(self, name)) is not None}


class AbstractValidationFigures(Section):
    """Errors of held-out rows under several calibrations.

    Attributes:
        folds: of the cross-validation; 1 where rows were held out once; not set for a test set.
        repeats: of the cross-validation, where there are several.
        rms_mm_of_repeats: by calibration, the RMS position error of each repeat [mm].
        nominal: the robot as drawn, with base and tool fitted to the training rows.
        geometric: the geometric calibration.
        hybrid: geometry and joint correction.
        coverage: share of the held-out coordinates that lie within the 95 % intervals that the hybrid predicts.
        predicted_rms_mm: RMS of the position errors that it predicts [mm].
        socket_distance: errors of stated distances between sockets that were left out.
        frames_fitted: number of frames that were held out whole; their bases were fitted to the held-out rows.
        sockets_held_out: number of sockets that were held out whole.
        rows_not_judged: number of held-out rows whose target or anchor no training row has.
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
    frames_fitted: int | None = None
    sockets_held_out: int | None = None
    rows_not_judged: int | None = None

    @property
    def models(self) -> dict[str, ErrorFigures]:
        """The calibrations that were judged, by name."""
        return {name: figures for name in MODELS if (figures := getattr(self, name)) is not None}


class ValidationFigures(AbstractValidationFigures):
    """See `AbstractValidationFigures`.

    Attributes:
        rows: number of held-out rows with a length; each counts once, however many repeats there are.
        rms_mm_of_simulations: by calibration, the RMS position error in each of several simulations [mm].
        mean_rms_mm: by calibration, the mean of these [mm].
    """

    rows: int
    rms_mm_of_simulations: dict[str, tuple[float, ...]] | None = None
    mean_rms_mm: dict[str, float] | None = None


class LearningPoint(AbstractValidationFigures):
    """Errors of held-out rows by calibrations with `rows` training rows; `held_out` rows were judged."""

    rows: int
    held_out: int
