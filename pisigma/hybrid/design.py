"""From linearised values and chosen features to normal equations, chunk by chunk."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.hybrid.evidence import FIRST_SIZE, GaussianPrior, Posterior, Sums
from pisigma.hybrid.sensor_values import SensorValues
from pisigma.identification.problem.loss import AbstractLoss, SquaredLoss
from pisigma.identification.problem.problem import CalibrationProblem
from pisigma.joint_correction.feature import AbstractFeature

CHUNK = 1_024
"""Rows whose columns are in memory at a time."""


@dataclass(frozen=True, eq=False)
class Design:
    """Which unknowns there are: the free parameters, and a weight for every used column of the features.

    Attributes:
        problem: rows and free parameters.
        features: of the joint corrections.
    """

    problem: CalibrationProblem
    features: tuple[AbstractFeature, ...]

    @property
    def active(self) -> int:
        """Number of free parameters, which come first."""
        return len(self.problem.active)

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return self.active + sum(int(chosen.used.sum()) for chosen in self.features)

    def stretch(self, number: int) -> slice:
        """Where the weights of a choice of features stand."""
        start = self.active + sum(int(chosen.used.sum()) for chosen in self.features[:number])
        return slice(start, start + int(self.features[number].used.sum()))

    def columns(self, values: SensorValues, rows: slice) -> Float64[Tensor, "values components unknowns"]:
        """Derivative of a sensor's values by all unknowns, not weighted."""
        state = self.problem.state
        blocks = [values.geometry[rows]]
        blocks += [values.feature_columns(chosen, state, rows) for chosen in self.features]
        return torch.cat(blocks, -1)

    def prior(self, prior_scale: Sequence[float]) -> GaussianPrior:
        """Prior of all unknowns, the classes' factors as the geometric calibration left them.

        A prismatic joint's weights are lengths; their sizes count in radians times the reach.
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
        fixed = problem.prior_sizes != "estimated"
        return GaussianPrior(torch.cat(base), torch.cat(group), torch.cat(sizes), classes, fixed)

    def prior_like(self, other: "Design", prior: GaussianPrior) -> GaussianPrior:
        """The prior with sizes to start from that another design's fit came to; new bands as its last one."""
        prior_here = self.prior(prior.sizes[: prior.classes].tolist())
        sizes = prior_here.sizes.clone()
        others = zip(other.features, other.group_starts(prior.classes), strict=True)
        fitted = {like.name: (first, len(like.group_names)) for like, first in others}
        for chosen, start in zip(self.features, self.group_starts(prior.classes), strict=True):
            if chosen.name in fitted:
                first, count = fitted[chosen.name]
                for number in range(len(chosen.group_names)):
                    sizes[start + number] = prior.sizes[first + min(number, count - 1)]
        return replace(prior_here, sizes=sizes)

    def group_starts(self, classes: int) -> list[int]:
        """Number of the first prior size of every choice of features."""
        counts = [len(chosen.group_names) for chosen in self.features]
        return [classes + sum(counts[:k]) for k in range(len(counts))]

    def indices(self, features: Sequence[AbstractFeature]) -> Int64[Tensor, " chosen"]:
        """Where the unknowns stand that a design with some of the features has.

        A smaller feature than the one of its name here, such as a series of fewer harmonics, counts as a part of it.
        """
        indices = [torch.arange(self.active)]
        for wanted in features:
            number = next(k for k, chosen in enumerate(self.features) if chosen.name == wanted.name)
            larger, start = self.features[number], self.stretch(number).start
            index = torch.cumsum(larger.used.flatten(), 0).view(larger.used.shape) - 1 + start
            columns = wanted.columns_in(larger)
            indices.append(index.gather(1, columns)[larger.used.gather(1, columns)])
        return torch.cat(indices)


def weighted_columns(
    design: Design, values: Sequence[SensorValues], here: Float64[Tensor, " unknowns"] | None = None
) -> tuple[list[Float64[Tensor, "values components unknowns"]], list[Float64[Tensor, "values components"]]]:
    """Columns and targets of all rows of every sensor at once, weighted; for data that fit into memory."""
    columns, targets = [], []
    for sensor in values:
        X = design.columns(sensor, slice(None))
        y = sensor.residual + (0.0 if here is None else X @ here)
        columns.append(X * sensor.root[:, None, None])
        targets.append(y * sensor.root[:, None])
    return columns, targets


def sum_up(design: Design, values: Sequence[SensorValues], here: Float64[Tensor, " unknowns"] | None) -> Sums:
    """Normal equations of all rows.

    Args:
        design: the unknowns.
        values: per sensor; rows that count not at all are left out already.
        here: the unknowns' values that the values were linearised at, counted from nominal.
    """
    size = design.unknowns
    normal = design.problem.q.new_zeros((len(values), size, size))
    descent = design.problem.q.new_zeros((len(values), size))
    square = []
    for k, sensor in enumerate(values):
        total = 0.0
        for start in range(0, len(sensor.row), CHUNK):
            rows = slice(start, min(start + CHUNK, len(sensor.row)))
            X = design.columns(sensor, rows)
            y = sensor.residual[rows] + (0.0 if here is None else X @ here)
            root = sensor.root[rows, None]
            X, y = (X * root[..., None]).flatten(0, 1), (y * root).flatten()
            normal[k].addmm_(X.t(), X)
            descent[k].addmv_(X.t(), y)
            total += float(y @ y)
        square.append(total)
    return Sums(
        normal=normal,
        descent=descent,
        square=tuple(square),
        count=tuple(float(sensor.residual.numel()) for sensor in values),
        stated=tuple(sensor.stated for sensor in values),
        exact=tuple(sensor.certain for sensor in values),
    )


@dataclass(frozen=True, eq=False)
class Rows:
    """Values of all sensors, linearised at one point.

    Attributes:
        problem: free parameters and joint values.
        values: per sensor, weighted, repeats of a pose as one row.
        here: free parameters counted from nominal where the values were linearised.
        configuration: number of every row's joint values; rows of one are never parted.
        weights: of the joint correction that was in force there; None for none.
    """

    problem: CalibrationProblem
    values: tuple[SensorValues, ...]
    here: Float64[Tensor, " active"]
    configuration: Int64[Tensor, " rows"]
    weights: Float64[Tensor, " weights"] | None = None

    @property
    def configurations(self) -> int:
        """How many different joint values there are."""
        return int(self.configuration.max()) + 1

    def of(self, chosen: Bool[Tensor, " configurations"] | Int64[Tensor, " chosen"]) -> "Rows":
        """The rows of some configurations, by mask or by number."""
        mask = torch.zeros(self.configurations, dtype=torch.bool, device=self.configuration.device)
        mask[chosen.to(mask.device)] = True
        kept = tuple(sensor.select(mask[self.configuration[sensor.row]]) for sensor in self.values)
        return replace(self, values=kept)

    def shuffled(self) -> Int64[Tensor, " configurations"]:
        """Numbers of all configurations in a random order that is always the same."""
        return torch.randperm(self.configurations, generator=torch.Generator().manual_seed(0))

    def weighted(self, weights: Sequence[Float64[Tensor, " _values"]]) -> "Rows":
        """The same with the values of every sensor weighted; then repeats of a pose are one row."""
        kept = [sensor.weighted(weight) for sensor, weight in zip(self.values, weights, strict=True)]
        if self.problem.pose is not None:
            kept = [sensor.collapsed(self.problem.pose) for sensor in kept]
        return replace(self, values=tuple(kept))

    def start(self, design: Design) -> Float64[Tensor, " unknowns"]:
        """All unknowns of a design where the values were linearised."""
        weights = self.weights
        if weights is None:
            weights = self.here.new_zeros(design.unknowns - len(self.here))
        return torch.cat([self.here, weights])

    def sample(self, most: int) -> "Rows":
        """At most so many configurations, drawn at random but always the same."""
        return self if self.configurations <= most else self.of(self.shuffled()[:most])

    def left(
        self, design: Design, posterior: Posterior, noise: Sequence[float]
    ) -> Float64[Tensor, " configurations"]:
        """Sum of squared residuals over variances of every configuration, under a posterior."""
        total = posterior.x.new_zeros(self.configurations)
        change = self.start(design) - posterior.x
        for sensor, sigma in zip(self.values, noise, strict=True):
            if sensor.certain or not len(sensor.row):
                continue
            residual = sensor.residual + design.columns(sensor, slice(None)) @ change
            square = (residual * sensor.root[:, None] / sigma).square().sum(1)
            total.index_add_(0, self.configuration[sensor.row], square)
        return total


def weigh(
    values: Sequence[SensorValues],
    design: Design,
    change: Float64[Tensor, " unknowns"],
    used: Sequence[float],
    loss: AbstractLoss,
) -> tuple[Float64[Tensor, " values"], ...]:
    """Weights of all rows of every sensor by their distance from a prediction.

    Args:
        values: not weighted.
        design: the unknowns.
        change: unknowns where the values were linearised, minus those of the prediction.
        used: values that the unknowns use up, per sensor.
        loss: how far-off rows count; its scale is automatic.
    """
    weights = []
    for sensor, taken in zip(values, used, strict=True):
        residual = torch.cat(
            [
                sensor.residual[rows] + design.columns(sensor, rows) @ change
                for rows in (slice(k, k + 1024) for k in range(0, len(sensor.row), 1024))
            ]
        )
        distance = residual.norm(dim=1) * sensor.root
        if sensor.certain or isinstance(loss, SquaredLoss):
            weights.append(torch.ones_like(distance))
            continue
        scale = max(loss.scale(distance, sensor.components, taken), 1e-10)
        weights.append(loss.weight(distance / scale, sensor.components))
    return tuple(weights)
