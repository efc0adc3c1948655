"""What a calibrated model knows: the values of all unknowns of its arm, and the root of their covariance."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.files.errors import MeasurementError, ModelError
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.input_products import InputProducts
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel

FLEET_PRIOR = "fleet_prior"
"""Kind of a model of what robots of one type have in common; each robot stands elsewhere."""


def check_fleet_prior(model: CalibratedModel) -> None:
    """Refuse a model that is not what robots of one type have in common.

    Raises:
        ModelError: it is of another kind.
    """
    if model.kind != FLEET_PRIOR:
        raise ModelError(
            f"model '{model.name}' is a model of one robot ({model.kind.replace('_', ' ')}), while what the robots of "
            "a fleet have in common was wanted as the prior; estimate that with `pisigma fleet prior FLEET --out DIR`, "
            "or add rows of the same robot with `pisigma recalibrate MODEL ROWS --out DIR`."
        )


@dataclass(frozen=True, eq=False)
class ModelPosterior:
    """Normal distribution of geometry, bases, tools, sensors' unknowns and weights of the joint correction.

    Attributes:
        space: the parameters, of the robot as drawn.
        geometry: their most probable values.
        features: of the joint correction, products of inputs among them.
        weights: of the used columns of the features.
        root: `R` with the covariance `R R^T` of the parameters, in the user's coordinates, and then of the weights.
        noise: per sensor [m or rad], see `pisigma.calibration.hybrid.uncertainty.PositionUncertainty`.
    """

    space: ParameterSpace
    geometry: IdentifiedGeometry
    features: tuple[AbstractFeature, ...]
    weights: Float64[Tensor, " weights"]
    root: Float64[Tensor, "unknowns directions"]
    noise: Mapping[str, float]

    @staticmethod
    def of(model: CalibratedModel) -> "ModelPosterior":
        """Take what a model of `pisigma calibrate` or `pisigma recalibrate` holds.

        Raises:
            ModelError: it holds no posterior, or not that of all unknowns.
        """
        known = model.uncertainty
        if known is None:
            raise ModelError(
                f"model '{model.name}' ({model.kind}) holds no posterior of its parameters, which rows could be added "
                "to; make it again with `pisigma calibrate ROBOT DATA --out DIR`, which calibrates a hybrid."
            )
        if not bool(torch.isfinite(known.geometry.values_of(known.space)).all()):
            raise ModelError(
                f"model '{model.name}' is of a version that did not keep where its sockets or anchors are; make it "
                "again with `pisigma calibrate ROBOT DATA --out DIR`."
            )
        correction = None if model.hybrid is None else model.hybrid.correction
        weights = known.root.new_zeros(0) if correction is None else _weights(correction, known.features)
        return ModelPosterior(known.space, known.geometry, known.features, weights, known.root, known.noise)

    @cached_property
    def usual_weights(self) -> Float64[Tensor, " weights"]:
        """Root mean square of the weights of every prior size, as far as the posterior says [rad or m]."""
        square = self.weights.square() + self.root[len(self.space.parameters) :].square().sum(1)
        first, numbers = 0, []
        for feature in self.features:
            numbers.append(feature.group[feature.used] + first)
            first += len(feature.group_names)
        number = torch.cat(numbers)
        count = torch.bincount(number, minlength=first).clamp(min=1)
        mean = torch.zeros(first, dtype=square.dtype).index_add(0, number, square) / count
        return mean.sqrt()[number]

    def renamed(self, rows: Measurements) -> Measurements:
        """Name the frame and the target of rows as the model does where one of them has no name for its only one.

        Raises:
            MeasurementError: the rows have the model's target for their frame, as where a camera is taken for fixed.
        """
        crossed = {*rows.frame} & {*self.geometry.tools} - {"", *self.geometry.bases}
        if crossed:
            raise MeasurementError(
                f"{rows.source}: '{crossed.pop()}' is the frame of rows, but in the model it is on the flange; of a "
                "camera, check --fixed-camera."
            )
        for field, stated, known in (
            ("frame", rows.frame, tuple(self.geometry.bases)),
            ("target", rows.target, tuple(self.geometry.tools)),
        ):
            if len(known) == len(set(stated)) == 1 and "" in (known[0], stated[0]):
                names: dict[str, Any] = {field: known * rows.rows}
                rows = replace(rows, **names)
        return rows

    def positions_in(self, space: ParameterSpace) -> list[int]:
        """Say where the parameters stand in a space that has all of their frames, targets and owners."""
        positions = list(range(self.space.arm_size))
        for group, names, among, size in (
            ("base", self.space.frames, space.frames, 6),
            ("tool", self.space.targets, space.targets, 6),
            *(
                (own.name, own.owners, other.owners, len(own.columns))
                for own in self.space.unknowns
                for other in space.unknowns
                if own.name == other.name
            ),
        ):
            for name in names:
                first = space.of(group).start + size * among.index(name)
                positions += range(first, first + size)
        return positions


def _weights(
    correction: JointCorrection, features: tuple[AbstractFeature, ...]
) -> Float64[Tensor, " weights"]:
    """Weights of the used columns of all features in their order, those of products from the product units."""
    linear = {own.name: weight for own, weight in zip(correction.features, correction.linear, strict=True)}
    blocks = [
        one.weights(correction.weight.detach())
        if isinstance(one, InputProducts)
        else linear[one.name].detach()[one.used]
        for one in features
    ]
    return torch.cat(blocks)
