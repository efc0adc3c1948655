"""Unknowns of a hybrid calibration, and the linearised values to which they are fitted."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.prior_scales import PriorGroup
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.hybrid.sensor_values import SensorValues
from pisigma.estimation.held_out import HeldOutErrors
from pisigma.estimation.loss import SquaredLoss
from pisigma.estimation.prior import FIRST_SIZE, GaussianPrior
from pisigma.estimation.regression import AbstractRegression, Posterior, SensorValueCount
from pisigma.files.errors import IdentificationError
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.measurement.conditions import JointState

CHUNK = 512
"""Number of rows whose columns are in memory at a time."""
FOLDS = 4
FOLDS_OF_FEW = 20
MAX_GROUPS = 400
"""Largest number of groups of rows that are held out."""


@dataclass(frozen=True, eq=False)
class Design:
    """Unknowns of a hybrid calibration: the free parameters, and a weight for every used column of the features.

    Attributes:
        problem: rows and free parameters.
        features: features of the joint correction.
    """

    problem: CalibrationProblem
    features: tuple[AbstractFeature, ...]

    @property
    def active_count(self) -> int:
        """Number of free parameters, which come first."""
        return len(self.problem.active)

    @property
    def class_count(self) -> int:
        """Number of classes of geometric parameters, whose prior scales are the first ones."""
        return len(PriorGroup)

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return self.active_count + sum(int(chosen.used.sum()) for chosen in self.features)

    def weights_of(self, feature_index: int) -> slice:
        """Return the indices of the weights of a feature."""
        start = self.active_count + sum(int(chosen.used.sum()) for chosen in self.features[:feature_index])
        return slice(start, start + int(self.features[feature_index].used.sum()))

    def correction(self, x: Float64[Tensor, " unknowns"], state: JointState) -> Float64[Tensor, "rows dof"]:
        """Compute the joint corrections [rad or m] of rows for given unknowns."""
        total = torch.zeros_like(state.q)
        for number, chosen in enumerate(self.features):
            weight = (
                torch.zeros(chosen.used.shape).to(x).masked_scatter(chosen.used, x[self.weights_of(number)])
            )
            total = total + (chosen.columns_of_rows(state) * weight).sum(-1)
        return total

    def predicted_change(
        self, values: SensorValues, change: Float64[Tensor, " unknowns"]
    ) -> Float64[Tensor, "values components"]:
        """Compute the unweighted change of a sensor's predicted values for a change of the unknowns."""
        moved = values.geometry_derivatives @ change[: self.active_count]
        if not self.features or not len(values.row):
            return moved
        for row, joints in values.row_derivatives:
            for rows in chunks(len(row)):
                delta = self.correction(change, self.problem.state[row[rows]])
                moved[rows] += torch.einsum("rcj,rj->rc", joints[rows], delta)
        return moved

    def columns(self, values: SensorValues, rows: slice) -> Float64[Tensor, "values components unknowns"]:
        """Compute the unweighted derivative of a sensor's values with respect to all unknowns."""
        state = self.problem.state
        blocks = [values.geometry_derivatives[rows]]
        blocks += [values.feature_columns(chosen, state, rows) for chosen in self.features]
        return torch.cat(blocks, -1)

    def prior(self, prior_scale: Sequence[float]) -> GaussianPrior:
        """Return the prior of all unknowns, with the prior scales of the geometric calibration.

        The weights of a prismatic joint are lengths; their prior standard deviations are angles [rad] times the reach.
        """
        problem, robot = self.problem, self.problem.space.robot
        base, group = [problem.precision[problem.active]], [problem.prior_group]
        sizes = [problem.q.new_tensor(list(prior_scale))]
        classes = len(prior_scale)
        unit = torch.where(torch.tensor(robot.revolute), 1.0, robot.reach**-2).to(problem.q)
        following = classes
        for chosen in self.features:
            used = chosen.used
            base.append(unit[:, None].expand(used.shape)[used])
            group.append(chosen.group[used] + following)
            count = len(chosen.group_names)
            sizes.append(torch.full((count,), FIRST_SIZE, dtype=torch.float64))
            following += count
        return GaussianPrior(torch.cat(base), torch.cat(group), torch.cat(sizes), classes)

    def usual_prior(self, prior_scale: Sequence[float]) -> GaussianPrior:
        """Return the prior of all unknowns, with the `usual_sizes` of the weights."""
        prior = self.prior(prior_scale)
        sizes = [size for chosen in self.features for size in chosen.usual_sizes]
        return replace(
            prior,
            group_scales=torch.cat(
                [prior.group_scales[: prior.geometric_class_count], prior.group_scales.new_tensor(sizes)]
            ),
        )

    def prior_with_scales_of(self, other: "Design", prior: GaussianPrior) -> GaussianPrior:
        """Return a prior with the fitted scales of another design; new bands get the scale of its last band."""
        prior_here = self.prior(prior.group_scales[: prior.geometric_class_count].tolist())
        sizes = prior_here.group_scales.clone()
        others = zip(other.features, other.first_scale_indices(prior.geometric_class_count), strict=True)
        fitted = {like.name: (first, len(like.group_names)) for like, first in others}
        for chosen, start in zip(
            self.features, self.first_scale_indices(prior.geometric_class_count), strict=True
        ):
            if chosen.name in fitted:
                first, count = fitted[chosen.name]
                for number in range(len(chosen.group_names)):
                    sizes[start + number] = prior.group_scales[first + min(number, count - 1)]
        return replace(prior_here, group_scales=sizes)

    def first_scale_indices(self, geometric_class_count: int) -> list[int]:
        """Return the index of the first prior scale of every feature."""
        counts = [len(chosen.group_names) for chosen in self.features]
        return [geometric_class_count + sum(counts[:k]) for k in range(len(counts))]

    def indices(self, features: Sequence[AbstractFeature]) -> Int64[Tensor, " chosen"]:
        """Return the indices of the unknowns of a design that has a subset of the features.

        A smaller feature of the same name, such as a series with fewer harmonics, is a part of the larger one.
        """
        indices = [torch.arange(self.active_count)]
        for wanted in features:
            number = next(k for k, chosen in enumerate(self.features) if chosen.name == wanted.name)
            larger, start = self.features[number], self.weights_of(number).start
            index = torch.cumsum(larger.used.flatten(), 0).view(larger.used.shape) - 1 + start
            columns = wanted.columns_in(larger)
            indices.append(index.gather(1, columns)[larger.used.gather(1, columns)])
        return torch.cat(indices)


@dataclass(frozen=True, eq=False)
class LinearisedRows:
    """Linearised rows of all sensors.

    Attributes:
        problem: free parameters and joint values.
        values: weighted values per sensor, with repeats of a pose as one row; residuals are those of the nominal
            parameters without a correction, by linearisation.
        group: index of every row's group; rows of a group, such as one placement of sockets, are held out together.
        rejected: indices of the rows whose values the loss rejects.
    """

    problem: CalibrationProblem
    values: tuple[SensorValues, ...]
    group: Int64[Tensor, " rows"]
    rejected: frozenset[int] = frozenset()

    @property
    def groups(self) -> int:
        """Number of groups."""
        return int(self.group.max()) + 1

    @property
    def sensors(self) -> tuple[SensorValueCount, ...]:
        """Number of values of every sensor."""
        return tuple(
            SensorValueCount(
                sensor.residual.numel() / sensor.repeat_variance_factor,
                sensor.has_stated_noise,
                sensor.are_values_given,
                sensor.repeat_variance_factor,
            )
            for sensor in self.values
        )

    def select_groups(self, groups: Int64[Tensor, " chosen"]) -> "LinearisedRows":
        """Return the rows of the given groups."""
        mask = torch.zeros(self.groups, dtype=torch.bool, device=self.group.device)
        mask[groups.to(mask.device)] = True
        kept = tuple(sensor.select(mask[self.group[sensor.row]]) for sensor in self.values)
        return replace(self, values=kept)

    def held_out_rows(self, groups: Int64[Tensor, " chosen"]) -> "LinearisedRows":
        """Return the rows of the given groups, without sensors whose values are given."""
        rows = self.select_groups(groups)
        kept = [sensor.select(slice(0, 0)) if sensor.are_values_given else sensor for sensor in rows.values]
        return replace(rows, values=tuple(kept))

    def folds(self, count: int, max_groups: int) -> tuple[Int64[Tensor, " _groups"], ...]:
        """Return the groups of every fold, drawn with a fixed random seed.

        Args:
            count: number of folds; one per group if there are fewer groups.
            max_groups: largest number of groups that are held out.
        """
        order = torch.randperm(self.groups, generator=torch.Generator().manual_seed(0))[:max_groups]
        count = min(count, len(order))
        return tuple(order[k::count] for k in range(count))

    @staticmethod
    def from_linearisation(
        design: Design,
        x: Float64[Tensor, " unknowns"],
        values: Sequence[SensorValues],
        weights: Sequence[Float64[Tensor, " _values"]],
        group: Int64[Tensor, " rows"],
    ) -> "LinearisedRows":
        """Return rows from values that were linearised at given unknowns; repeats of a pose become one row.

        Args:
            design: design of the unknowns.
            x: the unknowns, with parameters relative to nominal.
            values: values of all rows, with residuals at the given unknowns.
            weights: weights of the rows of every sensor.
            group: index of every row's group, see the attributes.
        """
        problem, rows = design.problem, []
        rejected = {row for sensor in values for row in sensor.row.tolist()}
        for sensor, weight in zip(values, weights, strict=True):
            one = sensor.apply_weights(weight)
            rejected -= set(one.row.tolist())
            if problem.pose is not None:
                one = one.merge_repeats(problem.pose)
            if problem.configuration is not None:
                one = one.downweight_correlated(problem.configuration)
            rows.append(replace(one, residual=one.residual + design.predicted_change(one, x)))
        return LinearisedRows(problem, tuple(rows), group, frozenset(rejected))

    def squared_difference(
        self, other: "LinearisedRows", x: Float64[Tensor, " unknowns"], design: Design, noise: Sequence[float]
    ) -> float:
        """Compute the sum of squared differences of weighted residuals, divided by the noise; infinite for other rows.

        Args:
            other: the same rows, linearised at another point.
            x: unknowns at which the residuals are compared.
            design: design of the unknowns.
            noise: noise per sensor.
        """
        total = 0.0
        for here, there, sigma in zip(self.values, other.values, noise, strict=True):
            if not torch.equal(here.row, there.row):
                return math.inf
            moved = design.predicted_change(here, x)
            first, second = ((one.residual - moved) * one.weight_root[:, None] for one in (here, there))
            total += float((first - second).square().sum()) / sigma**2
        return total


def chunks(count: int, size: int | None = None) -> list[slice]:
    """Yield ranges that split rows into chunks of the given size, by default `CHUNK`."""
    size = size or CHUNK
    return [slice(start, start + size) for start in range(0, count, size)]


def robust_weights(
    problem: CalibrationProblem, values: Sequence[SensorValues], effective_unknowns: float
) -> tuple[Float64[Tensor, " values"], ...]:
    """Compute the robust weights of all rows of every sensor from their residuals.

    Args:
        problem: the problem with the loss functions; the scale is estimated.
        values: unweighted values.
        effective_unknowns: effective number of unknowns.

    Raises:
        IdentificationError: a residual is not finite.
    """
    weights = []
    counts = [0.0 if sensor.are_values_given else float(sensor.residual.numel()) for sensor in values]
    for number, sensor in enumerate(values):
        loss = problem.loss_for_sensor(problem.sensors[number])
        distance = sensor.residual.norm(dim=1) * sensor.weight_root
        if not bool(torch.isfinite(distance).all()):
            raise IdentificationError(
                f"the joint correction predicts values of the sensor '{sensor.name}' that are not finite",
                value=sensor.name,
                remedy="calibrate the geometry alone, and look for huge values in the measurements",
            )
        if sensor.are_values_given or isinstance(loss, SquaredLoss):
            weights.append(torch.ones_like(distance))
            continue
        taken = effective_unknowns * counts[number] / max(sum(counts), 1.0)
        scale = max(float(loss.scale(distance, sensor.components, taken)), 1e-10)
        weights.append(loss.weight(distance / scale, sensor.components))
    return tuple(weights)


class AbstractDesignRegression(AbstractRegression):
    """Weighted linear regression `y = X x + e` of all measured values on the unknowns.

    Attributes:
        design: the unknowns.
    """

    design: Design

    @abstractmethod
    def select(self, design: Design) -> "AbstractDesignRegression":
        """Return the regression for a design with a subset of the features, or smaller features."""

    @abstractmethod
    def without_groups(self, groups: Int64[Tensor, " groups"]) -> "AbstractDesignRegression":
        """Return the regression without the values of groups of rows (see `Rows.group`), except given values."""

    @abstractmethod
    def held_out_errors(
        self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]]
    ) -> HeldOutErrors:
        """Return the errors of every fold, predicted without it, with the prior scales and the noise of a posterior.

        Args:
            posterior: posterior from all values.
            folds: groups that are held out together, see `Rows.group`.
        """

    def held_out_errors_refitted(
        self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]], noise_update_count: int
    ) -> HeldOutErrors:
        """Return the errors of every fold, predicted without it, with updated noise and prior scales."""
        parts = []
        for groups in folds:
            rest = self.without_groups(groups).maximise_evidence(
                posterior.prior, posterior.noise, noise_update_count
            )
            parts.append(self.held_out_errors(rest, [groups]))
        return HeldOutErrors.concatenate(parts)

    def evidence_gain(
        self, posterior: Posterior, design: Design, features: AbstractFeature
    ) -> tuple[float, Float64[Tensor, " groups"] | None]:
        """Compute the gain of log evidence by additional features, with fixed noise and all other prior scales fixed.

        Args:
            posterior: posterior without the features.
            design: design without the features.
            features: the additional features.

        Returns:
            The gain, or infinity if a fit takes no longer; and initial prior scales of the features.
        """
        return math.inf, None
