"""Rows with the names of a model, in which frames and targets are named after the days of their setup."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from pisigma.lifetime.cell.events import Event
from pisigma.measurement.dataset import Measurements
from pisigma.workflow.settings.recalibration import RecalibrationSettings


@dataclass(frozen=True, eq=False)
class RowsWithModelNames:
    """Rows with the names of a model's frame and target.

    Attributes:
        rows: the rows, with the names of the newest frame and target of the model.
        changed_frames: "base" or "tool" or both, if events since the model was made record that these were changed.
    """

    rows: Measurements
    changed_frames: tuple[str, ...]

    def settings_to_fit(self, settings: Any) -> Any:
        """Return settings that also fit a changed frame and tool, without cameras, because rows are already read."""
        fit_frame, fit_tool = settings.fit_frame or self.fit_frame, settings.fit_tool or self.fit_tool
        return replace(settings, cameras=None, fit_frame=fit_frame, fit_tool=fit_tool)

    def settings_to_recalibrate(self, settings: RecalibrationSettings) -> RecalibrationSettings:
        """Return settings with the moved parts, unless stated; cameras are removed, because rows are already read."""
        moved = (self.changed_frames or None) if settings.moved is None else settings.moved
        return replace(settings, cameras=None, moved=moved)

    @property
    def fit_frame(self) -> bool:
        """Whether the instrument was set up again."""
        return "base" in self.changed_frames

    @property
    def fit_tool(self) -> bool:
        """Whether the tool was changed."""
        return "tool" in self.changed_frames


def with_setup_names(rows: Measurements, frame_day: str, target_day: str) -> Measurements:
    """Return rows whose frame and target names state the day of their setup; day "" keeps the names of the file."""
    frame = tuple(setup_name(name, frame_day) for name in rows.frame)
    target = tuple(setup_name(name, target_day) for name in rows.target)
    return replace(rows, frame=frame, target=target)


def setup_name(name: str, day: str) -> str:
    """Return the name of a frame or target that was set up on a day; day "" for the first setup."""
    return f"{name} since {day}".lstrip() if day else name


def newest_day(events: Sequence[Event], kind: str, day: str) -> str:
    """Return the day of the newest event of a kind up to a given day; "" if there is none."""
    return max((one.day for one in events if one.kind == kind and one.day <= day), default="")
