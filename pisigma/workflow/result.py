"""Base class of the results that contain a model, with conversion to JSON and writing of the model folder."""

import os
from abc import ABC, abstractmethod
from dataclasses import replace
from pathlib import Path
from typing import Any

from pisigma.files.errors import AcceptanceError, Place, make_printable
from pisigma.files.output_folder import staged_folder
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.written_model import write_model
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.summary import AbstractSummary


class AbstractModelResult(ABC):
    """A model with all of its figures.

    Attributes:
        model: the model, with all figures as its metrics, as `pisigma.load` would read it.
        summary: the figures.
        seconds: computing time [s].
    """

    model: CalibratedModel
    summary: AbstractSummary
    seconds: float

    def to_json(self) -> dict[str, Any]:
        """Return all figures as JSON values, in mm and deg."""
        return {"seconds": round(self.seconds, 3), **self.summary.to_json()}

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """Return faults of the result, beginning with faults that make it implausible."""
        return self.summary.diagnostics

    @property
    def trusted(self) -> bool:
        """Whether no check found the result implausible."""
        return not any(one.severity == "implausible" for one in self.diagnostics)

    @property
    def held_out_p95_and_best_known_rms_mm(self) -> tuple[float | None, float | None]:
        """95 % quantile and RMS of the position errors [mm]; None if unknown.

        Both refer to held-out rows; without a validation, the RMS refers to the rows of the calibration.
        """
        return None, None

    def save(
        self,
        folder: str | os.PathLike[str],
        name: str | None = None,
        command: str | None = None,
        accept_implausible: bool = False,
        overwrite: bool = False,
    ) -> CalibratedModel:
        """Write the model folder with card and figures, completely or not at all.

        Args:
            folder: folder to write.
            name: name of the model; None for the name of the folder.
            command: command that made the model, for the card; None for the Python call.
            accept_implausible: whether to also write a result that a check found implausible; the card states the
                reason.
            overwrite: whether to replace an existing model.

        Returns:
            The model as written.

        Raises:
            AcceptanceError: a check found the result implausible.
            OutputError: the folder contains a model and `overwrite` is False, contains something else (see
                `pisigma.files.output_folder.check_folder`), or cannot be written.
        """
        if not (self.trusted or accept_implausible):
            raise AcceptanceError(
                "the result must not be trusted and was not written",
                at=Place(folder),
                remedy="correct what the diagnostics name, or accept implausible results explicitly "
                "(accept_implausible, --accept-implausible)",
            )
        summary = self.summary.with_figures(command=command)
        name = make_printable(name or Path(folder).resolve().name, cut=False)
        model = replace(self.model, name=name, metrics=summary.to_json())
        with staged_folder(folder, overwrite) as scratch:
            write_model(model, scratch)
            self._describe(model, summary, scratch)
        return model

    @abstractmethod
    def _describe(self, model: CalibratedModel, summary: Any, folder: Path) -> None:
        """Write card, figures and tables into the model folder."""
