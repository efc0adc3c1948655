"""Settings of an evaluation, and limits of acceptance."""

import math
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Annotated

from pisigma.files.errors import MeasurementError
from pisigma.files.setting import Option
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.validation.resampling import Bootstrap
from pisigma.workflow.settings.calibration import SocketDistances

if TYPE_CHECKING:
    from pisigma.validation.held_out.frames.fitted_frames import FrameKind
    from pisigma.validation.held_out.model_comparison import ModelFigures

_LIMITED = {
    "mean_mm": ("max-mean-mm", "mean position error"),
    "p95_mm": ("max-p95-mm", "95 % quantile of the position error"),
    "max_mm": ("max-mm", "largest position error"),
    "mean_deg": ("max-mean-deg", "mean orientation error"),
}


@dataclass(frozen=True)
class Limits:
    """Limits of acceptance; None if there is no limit.

    Attributes:
        mean_mm: limit on the mean position error [mm].
        p95_mm: limit on the 95 % quantile of the position error [mm].
        max_mm: limit on the largest position error [mm].
        mean_deg: limit on the mean orientation error [deg].

    Raises:
        MeasurementError: a limit is not positive and finite.
    """

    mean_mm: Annotated[float | None, Option("--max-mean-mm")] = None
    p95_mm: Annotated[float | None, Option("--max-p95-mm")] = None
    max_mm: float | None = None
    mean_deg: Annotated[float | None, Option("--max-mean-deg")] = None

    def __post_init__(self) -> None:
        """Check that limits are positive and finite."""
        for name, limit in self.stated_limits.items():
            if not (limit > 0 and math.isfinite(limit)):
                unit = name.split("_")[1]
                raise MeasurementError(
                    expected=f"a finite limit > 0 {unit}", value=limit, option=f"--{_LIMITED[name][0]}"
                )

    @property
    def stated_limits(self) -> dict[str, float]:
        """The limits that are not None, by name."""
        return {name: limit for name, limit in asdict(self).items() if limit is not None}

    def missed_by(self, model: "ModelFigures") -> list[str]:
        """Return the limits that a model misses, as clauses without a full stop; empty if it meets all.

        A model that cannot predict some of the rows misses every limit.

        Raises:
            MeasurementError: there is a limit on the orientation error, but no orientations were measured.
        """
        from pisigma.reporting.tables import number_text

        sentences = []
        for key, limit in self.stated_limits.items():
            option, what = _LIMITED[key]
            statistic, unit = key.split("_")
            errors = model.position if unit == "mm" else model.orientation
            if errors is None:
                raise MeasurementError(
                    "no orientations were measured",
                    value=limit,
                    option=f"--{option}",
                    remedy="omit the limit, or give rows with orientations",
                )
            value = errors.statistics[statistic]
            if not value <= limit:
                text = number_text(value) if number_text(value) != number_text(limit) else value
                sentences.append(
                    f"the {what} of {model.name} is {text} {unit}; --{option} allows {limit:g} {unit}"
                )
        if self.stated_limits and model.rows_not_predicted:
            sentences.append(f"{model.name} predicts nothing for {model.rows_not_predicted} of the rows")
        return sentences


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of an evaluation.

    Attributes:
        limits: acceptance limits for every model except the references.
        fit_frame: fit the frame of the sensor to these rows, for example after it was moved. Requires 6 poses or more.
        fit_tool: fit the position of the reflector to these rows, for example after it was replaced. Requires 6 poses
            or more.
        bootstrap: how confidence intervals are computed.
        cameras: cameras and boards, for files of detected board corners.
        socket_distances: known distances [m] by the names of two sockets, such as {("*/0", "*/1"): 0.05}. An asterisk
            stands for the same text in both names, here for every placement.
    """

    limits: Limits = field(default_factory=Limits)
    fit_frame: bool = False
    fit_tool: bool = False
    bootstrap: Bootstrap = field(default_factory=Bootstrap)
    cameras: CameraFiles | None = None
    socket_distances: SocketDistances = field(default_factory=dict)

    @property
    def fitted_kinds(self) -> "tuple[FrameKind, ...]":
        """Frames that are fitted to the rows."""
        from pisigma.validation.held_out.frames.fitted_frames import fitted_kinds

        return fitted_kinds(self.fit_frame, self.fit_tool)
