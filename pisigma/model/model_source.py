"""Where a model comes from: itself, what holds it, or its folder."""

import os
from typing import Protocol, runtime_checkable

from pisigma.model.calibrated_model import CalibratedModel

ModelSource = CalibratedModel | str | os.PathLike[str]
"""A model or its folder."""


@runtime_checkable
class HoldsModel(Protocol):
    """A `pisigma.CorrectedIK`, such as `pisigma.load` gives, or what `pisigma.calibrate` and its kin return."""

    @property
    def model(self) -> CalibratedModel:
        """The model."""


def model_or_folder(source: ModelSource | HoldsModel) -> ModelSource:
    """Give the model that something holds; a model or its folder as it is."""
    return source.model if isinstance(source, HoldsModel) else source
