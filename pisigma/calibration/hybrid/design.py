"""Which unknowns there are, and the linearised values that they are fitted to."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.prior_sizes import PriorGroup
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.hybrid.sensor_values import SensorValues
from pisigma.estimation.loss import SquaredLoss
from pisigma.estimation.prior import FIRST_SIZE, GaussianPrior
from pisigma.estimation.regression import SensorCount
from pisigma.files.errors import IdentificationError
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.measurement.conditions import JointState

CHUNK = 512
"""Rows whose columns are in memory at a time."""
FOLDS = 4
FOLDS_OF_FEW = 20
MOST_GROUPS = 400
"""So many groups of rows are held out at most."""


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
    def classes(self) -> int:
        """Number of classes of geometric parameters, whose prior sizes come first."""
        return len(PriorGroup)

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return self.active + sum(int(chosen.used.sum()) for chosen in self.features)

    def stretch(self, number: int) -> slice:
        """Where the weights of a choice of features stand."""
        start = self.active + sum(int(chosen.used.sum()) for chosen in self.features[:number])
        return slice(start, start + int(self.features[number].used.sum()))

    def correction(self, x: Float64[Tensor, " unknowns"], state: JointState) -> Float64[Tensor, "rows dof"]:
        """Joint corrections [rad or m] of rows with the weights of some unknowns."""
        total = torch.zeros_like(state.q)
        for number, chosen in enumerate(self.features):
            weight = torch.zeros(chosen.used.shape).to(x).masked_scatter(chosen.used, x[self.stretch(number)])
            total = total + (chosen.columns(state) * weight).sum(-1)
        return total

    def moved(
        self, values: SensorValues, change: Float64[Tensor, " unknowns"]
    ) -> Float64[Tensor, "values components"]:
        """Change of a sensor's predicted values with the unknowns, not weighted."""
        moved = values.geometry @ change[: self.active]
        if not self.features or not len(values.row):
            return moved
        for row, joints in values.sides:
            for rows in chunks(len(row)):
                delta = self.correction(change, self.problem.state[row[rows]])
                moved[rows] += torch.einsum("rcj,rj->rc", joints[rows], delta)
        return moved

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
        return GaussianPrior(torch.cat(base), torch.cat(group), torch.cat(sizes), classes)

    def usual_prior(self, prior_scale: Sequence[float]) -> GaussianPrior:
        """The prior of all unknowns with the weights' `usual_sizes`."""
        prior = self.prior(prior_scale)
        sizes = [size for chosen in self.features for size in chosen.usual_sizes]
        return replace(prior, sizes=torch.cat([prior.sizes[: prior.classes], prior.sizes.new_tensor(sizes)]))

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


@dataclass(frozen=True, eq=False)
class Rows:
    """Values of all sensors, linearised.

    Attributes:
        problem: free parameters and joint values.
        values: per sensor, weighted, repeats of a pose as one row; residuals are those of the nominal parameters and no
            correction, as far as the linearised values say.
        group: number of every row's group; rows of one, such as those of one placement of sockets, are held out
            together.
    """

    problem: CalibrationProblem
    values: tuple[SensorValues, ...]
    group: Int64[Tensor, " rows"]

    @property
    def groups(self) -> int:
        """How many groups there are."""
        return int(self.group.max()) + 1

    @property
    def sensors(self) -> tuple[SensorCount, ...]:
        """How many values there are of every sensor."""
        return tuple(
            SensorCount(
                sensor.residual.numel() / sensor.repetition, sensor.stated, sensor.certain, sensor.repetition
            )
            for sensor in self.values
        )

    def of(self, groups: Int64[Tensor, " chosen"]) -> "Rows":
        """The rows of some groups."""
        mask = torch.zeros(self.groups, dtype=torch.bool, device=self.group.device)
        mask[groups.to(mask.device)] = True
        kept = tuple(sensor.select(mask[self.group[sensor.row]]) for sensor in self.values)
        return replace(self, values=kept)

    def held_out(self, groups: Int64[Tensor, " chosen"]) -> "Rows":
        """The rows of some groups, without those of sensors that are certain."""
        rows = self.of(groups)
        kept = [sensor.select(slice(0, 0)) if sensor.certain else sensor for sensor in rows.values]
        return replace(rows, values=tuple(kept))

    def folds(self, count: int, most_groups: int) -> tuple[Int64[Tensor, " _groups"], ...]:
        """Numbers of the groups of every fold, drawn at random but always the same.

        Args:
            count: how many folds, or one for every group where there are fewer groups.
            most_groups: only so many groups are held out at all.
        """
        order = torch.randperm(self.groups, generator=torch.Generator().manual_seed(0))[:most_groups]
        count = min(count, len(order))
        return tuple(order[k::count] for k in range(count))

    @staticmethod
    def linearised(
        design: Design,
        x: Float64[Tensor, " unknowns"],
        values: Sequence[SensorValues],
        weights: Sequence[Float64[Tensor, " _values"]],
        group: Int64[Tensor, " rows"],
    ) -> "Rows":
        """Weighted values; repeats of a pose become one row.

        Args:
            design: the unknowns that the values were linearised at.
            x: these unknowns, the parameters counted from nominal.
            values: of all rows, with residuals there.
            weights: of the rows of every sensor.
            group: see the attributes.
        """
        problem, rows = design.problem, []
        for sensor, weight in zip(values, weights, strict=True):
            one = sensor.weighted(weight)
            if problem.pose is not None:
                one = one.collapsed(problem.pose)
            if problem.configuration is not None:
                one = one.shared(problem.configuration)
            rows.append(replace(one, residual=one.residual + design.moved(one, x)))
        return Rows(problem, tuple(rows), group)

    def difference(
        self, other: "Rows", x: Float64[Tensor, " unknowns"], design: Design, noise: Sequence[float]
    ) -> float:
        """Sum of the squared differences between weighted residuals, over the noise; infinite for other rows.

        Args:
            other: linearised at another point.
            x: unknowns at which the residuals are compared.
            design: of them.
            noise: per sensor.
        """
        total = 0.0
        for here, there, sigma in zip(self.values, other.values, noise, strict=True):
            if not torch.equal(here.row, there.row):
                return math.inf
            moved = design.moved(here, x)
            first, second = ((one.residual - moved) * one.root[:, None] for one in (here, there))
            total += float((first - second).square().sum()) / sigma**2
        return total


def chunks(count: int, size: int | None = None) -> list[slice]:
    """Rows that are worked on together: so many, or `CHUNK`."""
    size = size or CHUNK
    return [slice(start, start + size) for start in range(0, count, size)]


def weigh(
    problem: CalibrationProblem, values: Sequence[SensorValues], effective: float
) -> tuple[Float64[Tensor, " values"], ...]:
    """Weights of all rows of every sensor by the lengths of their residuals.

    Args:
        problem: how far-off rows of a sensor count; the scale is automatic.
        values: not weighted.
        effective: number of unknowns that the data determine.

    Raises:
        IdentificationError: a residual is not finite.
    """
    weights = []
    counts = [0.0 if sensor.certain else float(sensor.residual.numel()) for sensor in values]
    for number, sensor in enumerate(values):
        loss = problem.loss_of(problem.sensors[number])
        distance = sensor.residual.norm(dim=1) * sensor.root
        if not bool(torch.isfinite(distance).all()):
            raise IdentificationError(
                f"the joint correction predicts no finite value of the sensor '{sensor.name}'; calibrate the geometry "
                "alone, and look for values without limit in the measurements."
            )
        if sensor.certain or isinstance(loss, SquaredLoss):
            weights.append(torch.ones_like(distance))
            continue
        taken = effective * counts[number] / max(sum(counts), 1.0)
        scale = max(float(loss.scale(distance, sensor.components, taken)), 1e-10)
        weights.append(loss.weight(distance / scale, sensor.components))
    return tuple(weights)
