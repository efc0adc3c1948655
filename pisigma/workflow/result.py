"""What the results that hold a model have in common: they are JSON, and write themselves as model folders."""

import os
from abc import ABC, abstractmethod
from dataclasses import replace
from pathlib import Path
from typing import Any

from pisigma.files.errors import AcceptanceError, printable
from pisigma.files.output_folder import staged_folder
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.written_model import write_model
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.summary import AbstractSummary


class AbstractModelResult(ABC):
    """A model with all figures of it.

    Attributes:
        model: what `pisigma.load` would read, with all figures as its metrics.
        summary: the figures.
        seconds: time it took [s].
    """

    model: CalibratedModel
    summary: AbstractSummary
    seconds: float

    def to_json(self) -> dict[str, Any]:
        """Give all figures as JSON values, in mm and deg."""
        return {"seconds": round(self.seconds, 3), **self.summary.to_json()}

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """What is wrong with the result, those first that make it implausible."""
        return self.summary.diagnostics

    @property
    def trusted(self) -> bool:
        """Whether no check found the result implausible."""
        return not any(one.severity == "implausible" for one in self.diagnostics)

    def save(
        self,
        folder: str | os.PathLike[str],
        name: str | None = None,
        command: str | None = None,
        accept_implausible: bool = False,
        overwrite: bool = False,
    ) -> CalibratedModel:
        """Write the model folder with card and figures, whole or not at all.

        Args:
            folder: to write.
            name: of the model; None for the name of the folder.
            command: what made the model, for the card; None for the call.
            accept_implausible: write also what a check found implausible; the card says why.
            overwrite: whether a model that is there may be replaced.

        Returns:
            The model as written.

        Raises:
            AcceptanceError: a check found the result implausible.
            OutputError: the folder holds a model and is not to be overwritten, it is none of ours (see
                `pisigma.files.output_folder.check_folder`), or it cannot be written.
        """
        if not (self.trusted or accept_implausible):
            raise AcceptanceError(
                f"{folder} was not written, because the result must not be trusted; correct what the diagnostics "
                "name, or accept implausible results explicitly (accept_implausible, --accept-implausible)."
            )
        summary = self.summary.having(command=command)
        name = printable(name or Path(folder).resolve().name, cut=False)
        model = replace(self.model, name=name, metrics=summary.to_json())
        with staged_folder(folder, overwrite) as scratch:
            write_model(model, scratch)
            self._describe(model, summary, scratch)
        return model

    @abstractmethod
    def _describe(self, model: CalibratedModel, summary: Any, folder: Path) -> None:
        """Write card, figures and tables beside the model."""
