"""Calibration as a least-squares problem, with normal equations that are summed over chunks of poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.held_directions import HeldDirections
from pisigma.calibration.geometric.problem.least_squares import (
    AbstractLeastSquares,
    Linearisation,
    covariance_of,
)
from pisigma.calibration.geometric.problem.noise import (
    ContributionsAndNoise,
    SensorContribution,
    angle_variance_factor,
    contributions_and_noise_of,
    effective_parameters_by_sensor,
    group_variance_ratio,
    joined_contributions,
    noise_scales,
    rejects_rows,
    renumber,
)
from pisigma.calibration.geometric.problem.parameters import EVERYWHERE, ParameterSpace, PriorScaling
from pisigma.calibration.geometric.problem.prior_scales import (
    SMALLEST_PRIOR,
    converged_prior_scales,
    has_converged,
    prior_scales,
)
from pisigma.estimation.loss import AbstractLoss, SquaredLoss
from pisigma.measurement.conditions import JointState
from pisigma.measurement.sensors.sensor import AbstractSensor, Unknowns
from pisigma.robot.kinematics.parameter_jacobian import JACOBIAN_CHUNK, MotionMemory, ToolMotion, tool_motion

_CERTAIN_LOSS = SquaredLoss()
_CONVERGENCE_TOLERANCE = 1e-2
"""Relative change of noise and prior scales between points at convergence."""


@dataclass(frozen=True, eq=False)
class CalibrationProblem(AbstractLeastSquares[Tensor]):
    """Least-squares problem of a calibration: rows, sensors, free parameters and their prior.

    Attributes:
        space: the parameters; a point is a vector of all parameters.
        q: joint values of the rows [rad or m].
        frame: index of every row's frame.
        target: index of every row's target.
        sensors: measurements of the rows by sensor.
        loss: loss function.
        prior_mean: prior means of all parameters.
        precision: prior precision (1 / variance); 0 for parameters without a prior.
        active: indices of the free parameters.
        pose: index of every row's pose (joint values, frame, target); None if no pose is repeated.
        configuration: index of every row's joint values and frame; None if no configuration has several targets.
        pair_count: number of pairs of rows that are measured together, which come first.
        stated_conditions: conditions stated in the rows (see `JointState`), for corrections that depend on them.
        prior_scaling: "stated": prior scales are 1; "widened": at least 1; "estimated": estimated without bounds.
        held_directions: directions along which the search does not move, because the rows do not determine them.
        memory: cache of the last motion, shared by problems that differ only in free parameters or prior.
    """

    space: ParameterSpace
    q: Float64[Tensor, "rows dof"]
    frame: Int64[Tensor, " rows"]
    target: Int64[Tensor, " rows"]
    sensors: tuple[AbstractSensor, ...]
    loss: AbstractLoss
    prior_mean: Float64[Tensor, " parameters"]
    precision: Float64[Tensor, " parameters"]
    active: Int64[Tensor, " active"]
    pose: Int64[Tensor, " rows"] | None = None
    configuration: Int64[Tensor, " rows"] | None = None
    pair_count: int = 0
    stated_conditions: Mapping[str, Tensor] = field(default_factory=dict)
    prior_scaling: PriorScaling = "widened"
    held_directions: HeldDirections | None = None
    memory: MotionMemory = field(default_factory=MotionMemory, repr=False)

    @cached_property
    def step_scale(self) -> Float64[Tensor, " active"]:
        """Typical size of every unknown: 1 mm or 1 mrad."""
        return torch.from_numpy(self.space.usual_errors).to(self.q.device)[self.active]

    @property
    def rows(self) -> int:
        """Number of rows."""
        return self.q.shape[0]

    @cached_property
    def measured_value_counts(self) -> tuple[int, ...]:
        """Number of values of every sensor."""
        return tuple(int(sensor.present.sum()) * sensor.components for sensor in self.sensors)

    @cached_property
    def prior_group(self) -> Int64[Tensor, " active"]:
        """Group of the prior scale of every free parameter: its `PriorGroup`, or one for lengths or angles."""
        active = self.active
        if self.prior_scaling != "estimated":
            return self.space.is_length.to(active.device)[active].long()
        nonzero = (self.prior_mean.square() * self.precision > 1)[active].long()
        return self.space.prior_groups.to(active.device)[nonzero, active]

    def with_active(self, active: Sequence[int]) -> "CalibrationProblem":
        """Return the problem with other free parameters, and without held directions."""
        indices = torch.tensor(sorted(active), dtype=torch.int64, device=self.q.device)
        return replace(self, active=indices, held_directions=None)

    def without_prior(self) -> "CalibrationProblem":
        """Return the problem without a prior."""
        return replace(self, precision=torch.zeros_like(self.precision))

    def with_partners(self, rows: Int64[Tensor, " chosen"]) -> Int64[Tensor, " _rows"]:
        """Return rows with the other rows of their pairs, in ascending order if there are pairs."""
        if not self.pair_count:
            return rows
        partner = torch.where(rows < 2 * self.pair_count, rows ^ 1, rows)
        both: Tensor = torch.unique(torch.cat([rows, partner]))
        return both

    def select(self, rows: Int64[Tensor, " chosen"]) -> "CalibrationProblem":
        """Return the problem with some of the rows, including both rows of a pair."""
        rows = self.with_partners(rows)
        return replace(
            self,
            q=self.q[rows],
            frame=self.frame[rows],
            target=self.target[rows],
            sensors=tuple(sensor.select(rows) for sensor in self.sensors),
            pose=None if self.pose is None else renumber(self.pose[rows]),
            configuration=None if self.configuration is None else renumber(self.configuration[rows]),
            pair_count=int((rows < 2 * self.pair_count).sum()) // 2,
            stated_conditions={name: values[rows] for name, values in self.stated_conditions.items()},
            memory=MotionMemory(),
        )

    @cached_property
    def state(self) -> JointState:
        """Joint values and stated conditions of the rows, as a `JointState`."""
        return JointState(self.q, self.stated_conditions)

    def apply_step(self, point: Tensor, step: Tensor) -> Tensor:
        """Return all parameters after a step of the free parameters."""
        return point.index_add(0, self.active, step)

    def rms(self, linearisation: Linearisation[Tensor]) -> Float64[Tensor, ""]:
        """Return the RMS residual length of the first sensor [m or rad]."""
        return contributions_and_noise_of(linearisation).contributions[0].rms

    def linearise(self, point: Tensor, with_noise_of: Linearisation[Tensor] | None) -> Linearisation[Tensor]:
        """Sum the normal equations, with rows weighted by the noise of `with_noise_of`, or equally if None."""
        before = None if with_noise_of is None else contributions_and_noise_of(with_noise_of)
        unknowns = self.space.sensor_unknowns(point)
        chunks = []
        for rows in self.chunks():
            motion = self.motion(point, rows, self.active)
            chunks.append([self._sums(k, before, motion, unknowns, rows) for k in range(len(self.sensors))])
        parts = tuple(joined_contributions(of_sensor) for of_sensor in zip(*chunks, strict=True))
        view = (
            ContributionsAndNoise.without_noise(parts)
            if before is None
            else replace(before, contributions=parts)
        )
        return self.combine_contributions(point, view)

    def linearise_at_start(self, point: Tensor) -> Linearisation[Tensor]:
        """Linearise the problem at a start, with rows weighted by the noise estimated from them.

        If the loss rejects rows, they are linearised twice; otherwise gross errors would dominate the first step.
        """
        weighted = self.with_updated_noise(self.linearise(point, None))[0]
        losses = [self.loss_for_sensor(sensor) for sensor in self.sensors]
        if not rejects_rows(self.sensors, losses, contributions_and_noise_of(weighted)):
            return weighted
        return self.with_updated_noise(self.linearise(point, weighted))[0]

    def with_updated_noise(self, linearisation: Linearisation[Tensor]) -> tuple[Linearisation[Tensor], bool]:
        """Estimate noise (robustly), the weight of repeats, and the prior scales."""
        return self._renewed(linearisation, refine=False)

    def with_refined_noise(self, linearisation: Linearisation[Tensor]) -> Linearisation[Tensor]:
        """Estimate noise and prior scales from all rows without outliers, for the end of a search."""
        return self._renewed(linearisation, refine=True)[0]

    def _renewed(
        self, linearisation: Linearisation[Tensor], refine: bool
    ) -> tuple[Linearisation[Tensor], bool]:
        view = contributions_and_noise_of(linearisation)
        covariance = covariance_of(linearisation.normal)
        used = effective_parameters_by_sensor(view, covariance)
        noise = noise_scales(self.sensors, self.loss, view, used, refine)
        repetition = view.repeat_variance_factor
        if self.pose is not None or self.configuration is not None:
            repetition = group_variance_ratio(
                self.sensors, self.loss, replace(view, noise=noise), used, self.pose, self.configuration
            )
        off = self._off(linearisation.point)
        renewed = replace(view, noise=noise, repeat_variance_factor=repetition)
        if not refine and any(sensor.unit == "rad" for sensor in self.sensors):
            held = view.scaled_precision(self._prior, self.prior_group)
            renewed = replace(
                renewed, angle_variance_factor=angle_variance_factor(self.sensors, renewed, held, -held * off)
            )
        if self._sized:
            renewed = replace(renewed, prior_scale=self._prior_scales(renewed, off, covariance, refine))
        before, after = (
            torch.cat([one.noise, one.repeat_variance_factor, one.angle_variance_factor, one.prior_scale])
            for one in (view, renewed)
        )
        return self.combine_contributions(linearisation.point, renewed), has_converged(
            before, after, _CONVERGENCE_TOLERANCE
        )

    def _prior_scales(
        self, view: ContributionsAndNoise, off: Tensor, covariance: Tensor, refine: bool
    ) -> Float64[Tensor, " groups"]:
        """Estimate the prior scales; during a search, jointly with the step that results from them.

        Residuals are linearised for this purpose.
        """
        floor, prior = (
            1.0 if self.prior_scaling == "widened" else SMALLEST_PRIOR,
            (self._prior, self.prior_group),
        )
        scale = prior_scales(off, *prior, view.prior_scale, covariance, floor)
        if refine:
            return scale
        normal, descent = self._data_equations(view)
        return converged_prior_scales(normal, descent + normal @ off, *prior, scale, floor)

    @cached_property
    def _sized(self) -> bool:
        """Whether the problem has a prior with estimated scales."""
        return self.prior_scaling != "stated" and bool((self._prior > 0).any())

    def _off(self, point: Tensor) -> Float64[Tensor, " active"]:
        """Return the difference of the free parameters from their prior means."""
        return (point - self.prior_mean)[self.active]

    def loss_for_sensor(self, sensor: AbstractSensor) -> AbstractLoss:
        """Return the loss function of a sensor."""
        return _CERTAIN_LOSS if sensor.are_values_given else self.loss

    def chunks(self) -> list[slice]:
        """Return the rows in chunks that are processed together."""
        starts = range(0, self.rows, JACOBIAN_CHUNK)
        return [slice(start, min(start + JACOBIAN_CHUNK, self.rows)) for start in starts]

    def motion(self, point: Tensor, rows: slice, active: Tensor) -> ToolMotion:
        """Compute the tool poses of rows, and their derivatives with respect to the active parameters.

        The columns are 0 for bases and tools in rows of other frames and targets, and for parameters that do not move
        the tool.
        """
        make = partial(self._motion, point, rows)
        made_from = (point, self.space, self.q, self.frame, self.target, self.needs_rotation)
        motion = self.memory.motion(made_from, make) if rows == slice(0, self.rows) else make()
        columns = self.space.motion_columns.to(active.device)
        J = motion.derivative.index_select(0, columns[0].index_select(0, active))
        if not self.space.moves_in_all_rows:
            f, t = columns[1:, active, None]
            moving = ((f == EVERYWHERE) | (f == self.frame[rows])) & (
                (t == EVERYWHERE) | (t == self.target[rows])
            )
            J = J * moving[:, None, :]
        return ToolMotion(motion.position, motion.rotation, J)

    def _motion(self, point: Tensor, rows: slice) -> ToolMotion:
        """Compute the tool poses of rows, and their derivatives with respect to every kind of parameter."""
        dh, bases, tools = self.space.split(point)
        frame, target = (
            None if len(owners) == 1 else number[rows]
            for owners, number in ((bases, self.frame), (tools, self.target))
        )
        dh_rows, q, robot = dh.cpu().numpy(), self.q[rows], self.space.robot
        return tool_motion(robot, dh_rows, bases.t(), tools.t(), q, self.needs_rotation, frame, target)

    def prediction_derivative(
        self, sensor: AbstractSensor, motion: ToolMotion, unknowns: Unknowns, rows: slice, active: Tensor
    ) -> Tensor:
        """Compute the derivative of a sensor's values with respect to the parameters of the motion."""
        J = sensor.derivative(motion, unknowns, rows)
        for block in sensor.unknown_derivatives(motion, unknowns, rows):
            positions, owner, column = self.space.indices_in_group(block.group, active)
            if len(positions):
                theirs = (owner[:, None] == block.owner)[:, None, :]
                J = J.index_add(0, positions, block.derivative[column] * theirs)
        return J

    def combine_contributions(self, point: Tensor, view: ContributionsAndNoise) -> Linearisation[Tensor]:
        """Return the linearisation from the sensors' contributions, divided by their variances, and the prior."""
        off = self._off(point)
        precision = view.scaled_precision(self._prior, self.prior_group)
        pull = off * precision
        normal, descent = self._data_equations(view)
        normal.diagonal().add_(precision)
        descent.sub_(pull)
        if self.held_directions is not None:
            normal, descent = self.held_directions.restrict(normal, descent, self.step_scale)
        costs = [
            self.loss_for_sensor(sensor)
            .cost(part.residual_length / view.loss_scales[k], sensor.components)
            .sum()
            for k, (sensor, part) in enumerate(zip(self.sensors, view.contributions, strict=True))
        ]
        misfit = (torch.stack(costs) * view.loss_scales.square() / view.variances).sum()
        rounding = (self._rounding / view.variances).sum()
        cost = misfit + (off * pull).sum()
        return Linearisation(point, cost, descent, normal, misfit, rounding, view)

    def _data_equations(
        self, view: ContributionsAndNoise
    ) -> tuple[Float64[Tensor, "active active"], Float64[Tensor, " active"]]:
        """Return the total of the sensors' contributions, divided by their variances, without the prior."""
        terms = [
            (part.normal / variance, part.descent / variance)
            for part, variance in zip(view.contributions, view.variances, strict=True)
        ]
        normal, descent = terms[0]
        for more_normal, more_descent in terms[1:]:
            normal.add_(more_normal)
            descent.add_(more_descent)
        return normal, descent

    @cached_property
    def _rounding(self) -> Float64[Tensor, " sensors"]:
        """Sum of squared residuals that rounding errors cause, per sensor [m² or rad²]."""
        sizes = (self.space.robot.reach if sensor.unit == "m" else 1.0 for sensor in self.sensors)
        pairs = zip(self.measured_value_counts, sizes, strict=True)
        epsilon = torch.finfo(self.q.dtype).eps
        return self.q.new_tensor([values * (epsilon * size) ** 2 for values, size in pairs])

    @cached_property
    def needs_rotation(self) -> bool:
        """Whether any sensor requires the rotation of the tool."""
        return any(sensor.depends_on_rotation for sensor in self.sensors)

    @cached_property
    def _prior(self) -> Float64[Tensor, " active"]:
        return self.precision[self.active]

    @cached_property
    def measured_in_every_row(self) -> tuple[bool, ...]:
        """Whether every sensor has a value in all rows, per sensor."""
        return tuple(
            values == self.rows * sensor.components
            for values, sensor in zip(self.measured_value_counts, self.sensors, strict=True)
        )

    def _sums(
        self,
        number: int,
        view: ContributionsAndNoise | None,
        motion: ToolMotion,
        unknowns: Unknowns,
        rows: slice,
    ) -> SensorContribution:
        """Compute the contribution of a sensor in rows, weighted by its noise, or equally if `view` is None."""
        sensor, everywhere = self.sensors[number], self.measured_in_every_row[number]
        residual = sensor.residual(motion, unknowns, rows)
        if not everywhere:
            residual = torch.where(sensor.present[rows], residual, 0.0)
        distance = residual.square().sum(0).sqrt_()
        if sensor.sigma is not None:
            distance = torch.where(sensor.present[rows], distance / sensor.sigma[rows], 0.0)
        if view is None:
            root = torch.ones_like(distance)
        else:
            root = (
                self.loss_for_sensor(sensor)
                .weight(distance / view.loss_scales[number], sensor.components)
                .sqrt_()
            )
        if sensor.sigma is not None:
            root = root / sensor.sigma[rows]
        if not everywhere:
            root = torch.where(sensor.present[rows], root, 0.0)
        J = self.prediction_derivative(sensor, motion, unknowns, rows, self.active)
        # With the residual as its last row, one product A A^T gives the normal matrix and the right-hand side.
        A = J.new_empty((J.shape[0] + 1, *J.shape[1:]))
        torch.mul(J, root, out=A[:-1])
        torch.mul(residual, root, out=A[-1])
        A = A.flatten(1)
        sums, measured = A @ A.mT, self.measured_value_counts[number] // sensor.components
        return SensorContribution(sums[:-1, :-1], sums[:-1, -1], residual, distance, measured)
