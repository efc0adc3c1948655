"""Linearise all measured values at a point, with respect to geometry and joint values."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.noise import renumber
from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.measurement.conditions import JointState

_SAME_SIGHT = 1e-2
"""Relative difference of derivatives below which two rows of a pose measure the same."""
Shift = Callable[[JointState], Tensor]
"""Function that returns joint corrections [rad or m] for joint values and stated conditions."""


@dataclass(frozen=True, eq=False)
class SensorValues:
    """Linearised rows with values of one sensor.

    Attributes:
        name: name of the sensor.
        row: index of every row in the problem.
        geometry_derivatives: derivative of the predicted values with respect to the free parameters.
        joint_derivatives: derivative of the predicted values with respect to the joint values.
        residual: measured minus predicted values.
        weight_root: 1 / standard deviation if the rows state it, otherwise 1.
        has_stated_noise: whether the rows state their standard deviations.
        are_values_given: whether the values are given, not measured.
        other_row: index of the other row for distances between the targets of two rows; otherwise None.
        other_joint_derivatives: derivative with respect to the joint values of the other row.
        repeat_variance_factor: factor >= 1 on the variance, because values of several targets in one configuration
            share the errors of the model (design effect, Kish 1965).
    """

    name: str
    row: Int64[Tensor, " values"]
    geometry_derivatives: Float64[Tensor, "values components active"]
    joint_derivatives: Float64[Tensor, "values components dof"]
    residual: Float64[Tensor, "values components"]
    weight_root: Float64[Tensor, " values"]
    has_stated_noise: bool
    are_values_given: bool
    other_row: Int64[Tensor, " values"] | None = None
    other_joint_derivatives: Float64[Tensor, "values components dof"] | None = None
    repeat_variance_factor: float = 1.0

    @property
    def row_derivatives(self) -> list[tuple[Tensor, Tensor]]:
        """Return rows and derivatives with respect to their joint values; two of each for distances between rows."""
        sides = [(self.row, self.joint_derivatives)]
        if self.other_row is not None and self.other_joint_derivatives is not None:
            sides.append((self.other_row, self.other_joint_derivatives))
        return sides

    def feature_columns(
        self, feature: AbstractFeature, state: JointState, rows: slice
    ) -> Float64[Tensor, "values components weights"]:
        """Compute the derivative of the predicted values with respect to the weights of the used columns of a feature.

        Args:
            feature: the feature.
            state: joint state of all rows of the problem.
            rows: rows of this sensor to use.
        """
        blocks = [
            weight_columns(joints[rows], feature, state[row[rows]]) for row, joints in self.row_derivatives
        ]
        return blocks[0] if len(blocks) == 1 else blocks[0] + blocks[1]

    @property
    def components(self) -> int:
        """Number of values per row."""
        return self.residual.shape[1]

    def select(self, chosen: Tensor | slice) -> "SensorValues":
        """Return the rows that an index or mask selects."""
        return replace(
            self,
            row=self.row[chosen],
            geometry_derivatives=self.geometry_derivatives[chosen],
            joint_derivatives=self.joint_derivatives[chosen],
            residual=self.residual[chosen],
            weight_root=self.weight_root[chosen],
            other_row=None if self.other_row is None else self.other_row[chosen],
            other_joint_derivatives=None
            if self.other_joint_derivatives is None
            else self.other_joint_derivatives[chosen],
        )

    def apply_weights(self, weight: Float64[Tensor, " values"]) -> "SensorValues":
        """Return the rows with weights multiplied; rows with weight 0 are removed."""
        kept = weight > 0
        return replace(self.select(kept), weight_root=(self.weight_root * weight.sqrt())[kept])

    def merge_repeats(self, pose: Int64[Tensor, " rows"]) -> "SensorValues":
        """Return the rows with repeats of a pose joined to one row that has the sum of their weights.

        Repeats of a pose share the errors of the model, so they are not independent. Rows of a pose that measure
        something different, such as touches along another axis or distances from another anchor, have other derivatives
        and remain separate.
        """
        if not len(self.row) or self.other_row is not None:
            return self
        key = renumber(pose[self.row] * len(self.row) + self._sights(pose[self.row]))
        poses = int(key.max()) + 1
        if poses == len(key):
            return self
        weight = self.weight_root.square()
        total = weight.new_zeros(poses).index_add(0, key, weight)

        def mean(values: Tensor) -> Tensor:
            shape = (-1, *[1] * (values.ndim - 1))
            summed = values.new_zeros(poses, *values.shape[1:]).index_add(0, key, values * weight.view(shape))
            return summed / total.view(shape)

        first = torch.full((poses,), len(self.row), dtype=torch.int64, device=key.device)
        first = first.scatter_reduce(0, key, torch.arange(len(key), device=key.device), "amin")
        return replace(
            self,
            row=self.row[first],
            geometry_derivatives=mean(self.geometry_derivatives),
            joint_derivatives=mean(self.joint_derivatives),
            residual=mean(self.residual),
            weight_root=total.sqrt(),
        )

    def downweight_correlated(self, configuration: Int64[Tensor, " rows"]) -> "SensorValues":
        """Return the rows with smaller weights if residuals of several targets in a configuration are correlated."""
        if not len(self.row) or self.are_values_given or self.other_row is not None:
            return self
        key = renumber(configuration[self.row])
        groups = int(key.max()) + 1
        weight = self.weight_root.square()
        total = weight.new_zeros(groups).index_add(0, key, weight)
        summed = self.residual.new_zeros((groups, self.components)).index_add(
            0, key, self.residual * weight[:, None]
        )
        # Both means are equal if the residuals of a configuration are independent. If they are all the same, the second
        # is larger by a factor of the number of targets, which then count as one measurement.
        square = float((self.residual.square() * weight[:, None]).sum()) / len(key)
        shared = float((summed.square().sum(1) / total).sum()) / groups
        repetition = max(shared / max(square, 1e-300), 1.0)
        return replace(
            self, repeat_variance_factor=repetition, weight_root=self.weight_root * repetition**-0.5
        )

    def _sights(self, pose: Int64[Tensor, " values"]) -> Int64[Tensor, " values"]:
        """Return, for every row, the first row of its pose that has about the same derivatives."""
        J = torch.cat([self.geometry_derivatives.flatten(1), self.joint_derivatives.flatten(1)], 1)
        found, left = torch.zeros_like(pose), torch.arange(len(pose), device=pose.device)
        while len(left):
            first = torch.full_like(pose, len(pose)).scatter_reduce(0, pose[left], left, "amin")[pose[left]]
            same = (J[left] - J[first]).norm(dim=1) <= _SAME_SIGHT * J[first].norm(dim=1)
            found[left[same]] = first[same]
            left = left[~same]
        return found


def weight_columns(
    joint_derivatives: Float64[Tensor, "values components dof"], feature: AbstractFeature, state: JointState
) -> Float64[Tensor, "values components _weights"]:
    """Compute the derivative with respect to the weights of the used columns of a feature, concatenated for all joints.

    Args:
        joint_derivatives: derivative with respect to the joint values.
        feature: the feature.
        state: joint state of every row.
    """
    used = feature.used.flatten()
    block = (joint_derivatives[..., None] * feature.columns_of_rows(state)[:, None]).flatten(2)
    return block if bool(used.all()) else block[..., used]


def sensor_values(
    problem: CalibrationProblem, point: Float64[Tensor, " parameters"], correction_at: Shift | None = None
) -> tuple[SensorValues, ...]:
    """Return the values of every sensor, linearised at a point.

    Args:
        problem: rows, sensors and free parameters.
        point: values of all parameters.
        correction_at: joint corrections at the point; None for no correction.
    """
    robot = problem.space.robot
    moved = problem if correction_at is None else replace(problem, q=problem.q + correction_at(problem.state))
    index = torch.cat([problem.active, joint_value_parameters(problem.space).to(problem.q.device)])
    direction = problem.q.new_tensor(robot.directions)
    unknowns = problem.space.sensor_unknowns(point)
    collected: list[list[tuple[Tensor, ...]]] = [[] for _ in problem.sensors]
    for rows in moved.chunks():
        motion = moved.motion(point, rows, index)
        for sensor, columns in zip(moved.sensors, collected, strict=True):
            present = sensor.present[rows].nonzero()[:, 0]
            J = moved.prediction_derivative(sensor, motion, unknowns, rows, index)[..., present].permute(
                2, 1, 0
            )
            r = sensor.residual(motion, unknowns, rows)[..., present].t()
            other = sensor.partner_derivative(motion)[len(problem.active) :][..., present].permute(2, 1, 0)
            columns.append((present + rows.start, J, r, other))
    values = []
    for sensor, columns in zip(problem.sensors, collected, strict=True):
        row, J, r, other = (torch.cat(column) for column in zip(*columns, strict=True))
        joints, paired = J[..., len(problem.active) :] * direction, sensor.is_paired
        root = torch.ones_like(r[:, 0]) if sensor.sigma is None else 1 / sensor.sigma[row]
        values.append(
            SensorValues(
                name=sensor.name,
                row=row,
                geometry_derivatives=J[..., : len(problem.active)].contiguous(),
                joint_derivatives=joints - other * direction if paired else joints,
                residual=r.contiguous(),
                weight_root=root,
                has_stated_noise=sensor.sigma is not None,
                are_values_given=sensor.are_values_given,
                other_row=row + 1 if paired else None,
                other_joint_derivatives=other * direction if paired else None,
            )
        )
    return tuple(values)


def joint_value_parameters(space: ParameterSpace) -> Int64[Tensor, " dof"]:
    """Return for every joint the parameter that acts like its value: theta of a revolute, d of a prismatic joint."""
    robot = space.robot
    return torch.tensor(
        [5 * row + (0 if turns else 1) for row, turns in zip(robot.joint_rows, robot.revolute, strict=True)]
    )
