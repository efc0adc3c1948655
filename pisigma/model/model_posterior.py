"""Posterior of a calibrated model: values of all unknowns, and a root of their covariance."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.noise import CalibrationNoise
from pisigma.files.errors import MeasurementError, ModelError, Place
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.input_products import InputProducts
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel

FLEET_PRIOR = "fleet_prior"
"""Kind of a model that contains the prior of a fleet: the distribution of all errors except those of base and tool."""


def check_fleet_prior(model: CalibratedModel) -> None:
    """Check that a model is the prior of a fleet.

    Raises:
        ModelError: the model is of another kind.
    """
    if model.kind != FLEET_PRIOR:
        raise ModelError(
            f"expected the prior of a fleet, got model '{model.name}' of one robot ({model.kind.replace('_', ' ')})",
            expected="the prior of a fleet",
            value=model.kind,
            remedy="estimate the prior with `pisigma fleet prior FLEET --out DIR`, or add rows of the same robot with "
            "`pisigma recalibrate MODEL ROWS --out DIR`",
        )


@dataclass(frozen=True, eq=False)
class ModelPosterior:
    """Normal distribution of geometry, bases, tools, unknown sensor parameters and weights of the joint correction.

    Attributes:
        space: parameters, as deviations from the nominal robot.
        geometry: most probable values of the parameters.
        features: features of the joint correction, including products of inputs.
        weights: weights of the used columns of the features.
        covariance_root: root `R` of the covariance `R R^T`, with the rows of the parameters, in the user's coordinates,
            followed by the rows of the weights.
        noise: noise of the sensors of the calibration.
    """

    space: ParameterSpace
    geometry: IdentifiedGeometry
    features: tuple[AbstractFeature, ...]
    weights: Float64[Tensor, " weights"]
    covariance_root: Float64[Tensor, "unknowns directions"]
    noise: CalibrationNoise

    @staticmethod
    def from_model(model: CalibratedModel) -> "ModelPosterior":
        """Return the posterior of a model that `pisigma calibrate` or `pisigma recalibrate` made.

        Raises:
            ModelError: the model has no posterior, or its posterior lacks unknowns.
        """
        known = model.uncertainty
        if known is None:
            raise ModelError(
                f"model '{model.name}' ({model.kind}) has no posterior of its parameters that rows could update",
                value=model.kind,
                remedy="calibrate a hybrid with `pisigma calibrate ROBOT DATA --out DIR`",
            )
        if not bool(torch.isfinite(known.geometry.values_of(known.space)).all()):
            raise ModelError(
                f"model '{model.name}' was written by a version that did not store the positions of its sockets or "
                "anchors",
                remedy="calibrate it again with `pisigma calibrate ROBOT DATA --out DIR`",
            )
        correction = None if model.hybrid is None else model.hybrid.correction
        weights = (
            known.dense_root.new_zeros(0) if correction is None else _weights(correction, known.features)
        )
        return ModelPosterior(
            known.space, known.geometry, known.features, weights, known.dense_root, known.noise
        )

    @cached_property
    def rms_weights(self) -> Float64[Tensor, " weights"]:
        """Posterior root mean square [rad or m] of the weights that share a prior scale, for every weight."""
        square = self.weights.square() + self.covariance_root[len(self.space.parameters) :].square().sum(1)
        first, numbers = 0, []
        for feature in self.features:
            numbers.append(feature.group[feature.used] + first)
            first += len(feature.group_names)
        number = torch.cat(numbers)
        count = torch.bincount(number, minlength=first).clamp(min=1)
        mean = torch.zeros(first, dtype=square.dtype).index_add(0, number, square) / count
        return mean.sqrt()[number]

    def with_model_names(self, rows: Measurements) -> Measurements:
        """Return rows with the model's names of frame and target, if either has a single frame or target without name.

        Raises:
            MeasurementError: the frame of the rows is a target of the model, as when a camera is wrongly treated as
                fixed.
        """
        crossed = {*rows.frame} & {*self.geometry.tools} - {"", *self.geometry.bases}
        if crossed:
            name = crossed.pop()
            raise MeasurementError(
                f"'{name}' is a measuring frame of the rows, but in the model it is mounted on the flange",
                value=name,
                at=Place(rows.source, column="frame"),
                remedy=f"check --fixed-camera if '{name}' is a camera",
            )
        for field, stated, known in (
            ("frame", rows.frame, tuple(self.geometry.bases)),
            ("target", rows.target, tuple(self.geometry.tools)),
        ):
            if len(known) == len(set(stated)) == 1 and "" in (known[0], stated[0]):
                names: dict[str, Any] = {field: known * rows.rows}
                rows = replace(rows, **names)
        return rows

    def parameter_indices_in(self, space: ParameterSpace) -> list[int]:
        """Return the indices of the parameters in a space that contains all their frames, targets and owners."""
        positions = list(range(self.space.arm_parameter_count))
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
                first = space.indices_of(group).start + size * among.index(name)
                positions += range(first, first + size)
        return positions


def _weights(
    correction: JointCorrection, features: tuple[AbstractFeature, ...]
) -> Float64[Tensor, " weights"]:
    """Return the weights of the used columns of all features; those of products come from product units."""
    linear = {own.name: weight for own, weight in zip(correction.features, correction.linear, strict=True)}
    blocks = [
        one.weights(correction.weight.detach())
        if isinstance(one, InputProducts)
        else linear[one.name].detach()[one.used]
        for one in features
    ]
    return torch.cat(blocks)
