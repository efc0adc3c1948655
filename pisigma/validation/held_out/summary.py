"""Base class of the figures of models, from which the JSON of commands and the metrics of model folders are made."""

from typing import Any, ClassVar, TypeVar

from pydantic import ValidationError

from pisigma.files.errors import ModelError
from pisigma.files.yaml_file import StoredFigures
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.validation.held_out.diagnostic import Diagnostic

Summary = TypeVar("Summary", bound="AbstractSummary")


class AbstractSummary(StoredFigures):
    """All figures of a model. Figures that do not exist are unset and omitted from JSON.

    Attributes:
        kinds: kinds of models that have these metrics.
        command: command line or call that made the model.
        diagnostics: findings of the checks; findings that make the result implausible come first.
    """

    kinds: ClassVar[tuple[str, ...]]
    command: str = ""
    diagnostics: tuple[Diagnostic, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return all figures that are set as JSON values, by name."""
        return self.model_dump(mode="json", exclude_unset=True, by_alias=True)

    def with_figures(self: Summary, **figures: object) -> Summary:
        """Return a copy with further figures; figures that are None are omitted."""
        return self.model_copy(update={name: value for name, value in figures.items() if value is not None})

    @classmethod
    def read(cls: type[Summary], model: CalibratedModel) -> Summary | None:
        """Return the figures that a model stores.

        Returns:
            The figures; None for a model of another kind, or one without figures.

        Raises:
            ModelError: the figures do not have the form of this version.
        """
        if model.kind not in cls.kinds or not model.metrics:
            return None
        try:
            return cls.model_validate(model.metrics)
        except ValidationError as problem:
            first = problem.errors()[0]
            key = ".".join(map(str, first["loc"]))
            raise ModelError(
                f"model '{model.name}': invalid metrics for this kind of model ({key}: {first['msg']})",
                value=key,
                remedy="make the model again, or run `pisigma upgrade` on the folder of an earlier version",
            ) from None
