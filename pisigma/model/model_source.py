"""Sources of a model: the model itself, an object that has it, or its folder."""

import os
from typing import Protocol, runtime_checkable

from pisigma.model.calibrated_model import CalibratedModel

ModelSource = CalibratedModel | str | os.PathLike[str]
"""A model, or the path of its folder."""


@runtime_checkable
class HasModel(Protocol):
    """Object with a model: a `pisigma.CorrectedIK`, or a result of `pisigma.calibrate` and similar functions."""

    @property
    def model(self) -> CalibratedModel:
        """The calibrated model."""


def model_or_folder(source: ModelSource | HasModel) -> ModelSource:
    """Return the model of an object that has one; a model or a folder is returned as it is."""
    return source.model if isinstance(source, HasModel) else source
