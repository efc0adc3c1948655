"""What the figures of all kinds of models have in common: they are JSON, and the metrics of a model on disk."""

from typing import Any, ClassVar, TypeVar

from pydantic import ValidationError

from pisigma.files.errors import ModelError
from pisigma.files.yaml_file import Section
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.validation.held_out.diagnostic import Diagnostic

Summary = TypeVar("Summary", bound="AbstractSummary")


class AbstractSummary(Section):
    """All figures of a model. What does not exist is not set and stands in no JSON.

    Attributes:
        kinds: of the models whose metrics these figures are.
        command: what made the model: a command line or a call.
        diagnostics: what is wrong with the result, those first that make it implausible.
    """

    kinds: ClassVar[tuple[str, ...]]
    command: str = ""
    diagnostics: tuple[Diagnostic, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Give everything that is set as JSON values, by name."""
        return self.model_dump(mode="json", exclude_unset=True)

    def having(self: Summary, **figures: object) -> Summary:
        """Give the same with more figures; those that are None are left out."""
        return self.model_copy(update={name: value for name, value in figures.items() if value is not None})

    @classmethod
    def read(cls: type[Summary], model: CalibratedModel) -> Summary | None:
        """Read the figures that a model keeps.

        Returns:
            None for a model of another kind, and for one that keeps no figures.

        Raises:
            ModelError: the figures are not in the form of this version.
        """
        if model.kind not in cls.kinds or not model.metrics:
            return None
        try:
            return cls.model_validate(model.metrics)
        except ValidationError as problem:
            first = problem.errors()[0]
            key = ".".join(map(str, first["loc"]))
            raise ModelError(
                f"model '{model.name}': the metrics are not those of this kind of model ({key}: {first['msg']}); "
                "make the model again, or run `pisigma upgrade` on the folder of an earlier version."
            ) from None
