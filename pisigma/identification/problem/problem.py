"""The calibration as a least-squares problem: normal equations summed over chunks of poses."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.identification.problem.least_squares import AbstractLeastSquares, Linearisation, covariance_of
from pisigma.identification.problem.loss import AbstractLoss, SquaredLoss
from pisigma.identification.problem.noise import (
    ALWAYS_GOOD,
    SMALLEST_PRIOR,
    SensorSums,
    SensorView,
    angle_disagreement,
    group_variance_ratio,
    joined_sums,
    loss_scale,
    prior_group_of,
    prior_scales,
    renumbered,
    values_used,
    view_of,
)
from pisigma.identification.problem.parameters import EVERYWHERE, ParameterSpace, PriorSizes
from pisigma.kinematics.parameter_jacobian import JACOBIAN_CHUNK, ToolMotion, tool_motion
from pisigma.measurement.conditions import JointState
from pisigma.sensors.sensor import AbstractSensor, Unknowns

CERTAIN_LOSS = SquaredLoss()
SETTLED = 1e-2
"""Estimates of noise and of the prior's sizes have settled that change by a smaller share from point to point."""
PRIOR_ROUNDS, PRIOR_SETTLED = 8, 1e-3
"""At one point the prior's sizes are estimated anew so often at most, or until they change by a smaller share."""


class MotionMemory:
    """The motion at the last point, which the rank analysis, the search and its next stage all ask for.

    What the motion was made from is compared by identity; so points are replaced and never changed in place.
    """

    def __init__(self) -> None:
        self._made_from: tuple[object, ...] = ()
        self._motion: ToolMotion | None = None

    def motion(self, made_from: tuple[object, ...], make: Callable[[], ToolMotion]) -> ToolMotion:
        """Return the motion that was made from the same objects, or else a new one."""
        same = len(made_from) == len(self._made_from) and all(
            one is other for one, other in zip(made_from, self._made_from, strict=True)
        )
        if not same or self._motion is None:
            self._made_from, self._motion = made_from, make()
        return self._motion


@dataclass(frozen=True, eq=False)
class CalibrationProblem(AbstractLeastSquares[Tensor]):
    """Rows, sensors, the parameters that are free and what the prior says of them.

    Attributes:
        space: the parameters; a point is a vector of all of them.
        q: joint values [rad or m] of the rows.
        frame: index of every row's frame.
        target: index of every row's target.
        sensors: what was measured in the rows.
        loss: how rows far from their prediction count.
        nominal: values of all parameters that the prior is about.
        precision: 1 / variance of their errors by the prior, 0 where it says nothing.
        active: indices of the free parameters.
        pose: number of every row's pose (joint values, frame, target), None where no pose is repeated.
        configuration: number of every row's joint values and frame, None where none is seen of several targets.
        pairs: so many pairs of rows, the first ones, are measured together.
        stated: what rows state beside their joint values (see `JointState`), for corrections that depend on it.
        prior_sizes: "stated": the prior as it is; "widened": wider where the errors are larger than it says;
            "estimated": wider or narrower.
        memory: the last motion; shared with problems that differ in their free parameters or prior only.
    """

    space: ParameterSpace
    q: Float64[Tensor, "rows dof"]
    frame: Int64[Tensor, " rows"]
    target: Int64[Tensor, " rows"]
    sensors: tuple[AbstractSensor, ...]
    loss: AbstractLoss
    nominal: Float64[Tensor, " parameters"]
    precision: Float64[Tensor, " parameters"]
    active: Int64[Tensor, " active"]
    pose: Int64[Tensor, " rows"] | None = None
    configuration: Int64[Tensor, " rows"] | None = None
    pairs: int = 0
    stated: Mapping[str, Tensor] = field(default_factory=dict)
    prior_sizes: PriorSizes = "widened"
    memory: MotionMemory = field(default_factory=MotionMemory, repr=False)

    @cached_property
    def step_scale(self) -> Float64[Tensor, " active"]:
        """1 mm and 1 mrad."""
        return torch.from_numpy(self.space.usual_errors).to(self.q.device)[self.active]

    @cached_property
    def values_measured(self) -> tuple[int, ...]:
        """Number of values of every sensor."""
        return tuple(int(sensor.present.sum()) * sensor.components for sensor in self.sensors)

    @cached_property
    def prior_group(self) -> Int64[Tensor, " active"]:
        """Which size of the prior every free parameter has: of its `PriorGroup`, or for lengths and for angles."""
        drawn = (self.nominal.square() * self.precision > 1).tolist()
        groups = []
        for index in self.active.tolist():
            parameter = self.space.parameters[index]
            own = prior_group_of(parameter.group, drawn[index])
            groups.append(own if self.prior_sizes == "estimated" else int(parameter.unit == "m"))
        return torch.tensor(groups, dtype=torch.int64, device=self.q.device)

    def with_active(self, active: Sequence[int]) -> "CalibrationProblem":
        """The same with other free parameters."""
        return replace(self, active=torch.tensor(sorted(active), dtype=torch.int64, device=self.q.device))

    def without_prior(self) -> "CalibrationProblem":
        """The same without a prior."""
        return replace(self, precision=torch.zeros_like(self.precision))

    def with_partners(self, rows: Int64[Tensor, " chosen"]) -> Int64[Tensor, " _rows"]:
        """Some rows and, of pairs, the other ones; in ascending order where there are pairs."""
        if not self.pairs:
            return rows
        partner = torch.where(rows < 2 * self.pairs, rows ^ 1, rows)
        both: Tensor = torch.unique(torch.cat([rows, partner]))
        return both

    def select(self, rows: Int64[Tensor, " chosen"]) -> "CalibrationProblem":
        """Some of the rows; of a pair both."""
        rows = self.with_partners(rows)
        return replace(
            self,
            q=self.q[rows],
            frame=self.frame[rows],
            target=self.target[rows],
            sensors=tuple(sensor.select(rows) for sensor in self.sensors),
            pose=None if self.pose is None else renumbered(self.pose[rows]),
            configuration=None if self.configuration is None else renumbered(self.configuration[rows]),
            pairs=int((rows < 2 * self.pairs).sum()) // 2,
            stated={name: values[rows] for name, values in self.stated.items()},
            memory=MotionMemory(),
        )

    @cached_property
    def state(self) -> JointState:
        """Joint values of the rows, and what is stated beside them."""
        return JointState(self.q, self.stated)

    def moved(self, point: Tensor, step: Tensor) -> Tensor:
        """The parameters after a step of the free ones."""
        return point.index_add(0, self.active, step)

    def linearise(self, point: Tensor, like: Linearisation[Tensor] | None) -> Linearisation[Tensor]:
        """Sum up the normal equations; rows are weighted by the noise of `like`, where None by that which they show."""
        before = None if like is None else view_of(like)
        noise = (float("inf"),) * len(self.sensors) if before is None else before.noise
        unknowns = self.space.sensor_unknowns(point)
        chunks = []
        for rows in self.chunks():
            motion = self.motion(point, rows, self.active)
            chunks.append([self._sums(k, sigma, motion, unknowns, rows) for k, sigma in enumerate(noise)])
        sums = [joined_sums(of_sensor) for of_sensor in zip(*chunks, strict=True)]
        ones = (1.0,) * len(sums)
        view = (
            SensorView(tuple(sums), ones, ones, ones) if before is None else replace(before, sums=tuple(sums))
        )
        linearisation = self.combined(point, view)
        if before is not None:
            return linearisation
        # gross errors would decide the first step, so the rows are weighted by what they show of the noise
        weighted = self.renewed(linearisation)[0]
        return self.linearise(point, weighted) if self._rejects(view_of(weighted)) else linearisation

    def _rejects(self, view: SensorView) -> bool:
        """Whether the loss rejects any row."""
        return any(
            not bool(self.loss_of(sensor).weight(sums.distance / view.scale(k), sensor.components).all())
            for k, (sensor, sums) in enumerate(zip(self.sensors, view.sums, strict=True))
        )

    def renewed(self, linearisation: Linearisation[Tensor]) -> tuple[Linearisation[Tensor], bool]:
        """Estimate the noise robustly, what repeats are worth, and how wide the prior has to be."""
        return self._renewed(linearisation, refine=False)

    def refined(self, linearisation: Linearisation[Tensor]) -> Linearisation[Tensor]:
        """The same with the noise estimated from all good rows, for the end of a search."""
        return self._renewed(linearisation, refine=True)[0]

    def _renewed(
        self, linearisation: Linearisation[Tensor], refine: bool
    ) -> tuple[Linearisation[Tensor], bool]:
        view = view_of(linearisation)
        covariance = covariance_of(linearisation.normal)
        used = values_used(view, covariance)
        noise = loss_scale(self.sensors, self.loss, view, used, refine)
        repetition = view.repetition
        if self.pose is not None or self.configuration is not None:
            renewed_noise = replace(view, noise=noise)
            repetition = group_variance_ratio(
                self.sensors, self.loss, renewed_noise, used, self.pose, self.configuration
            )
        off = self._off(linearisation.point)
        renewed = replace(view, noise=noise, repetition=repetition)
        if not refine and self._angular:
            held = view.scaled(self._prior, self.prior_group)
            renewed = replace(
                renewed, disagreement=angle_disagreement(self.sensors, renewed, held, -held * off)
            )
        if self._sized:
            sized = replace(renewed, prior_scale=self._prior_scales(off, view, covariance))
            renewed = sized if refine else self._with_settled_prior(sized, off)
        return self.combined(linearisation.point, renewed), _alike(view, renewed)

    def _with_settled_prior(self, view: SensorView, off: Tensor) -> SensorView:
        """Estimate the prior's sizes together with the step that they lead to.

        Residuals being linear in the step, that takes no further linearisation.
        """
        normal, descent = self._data_sums(view)
        pull = descent + normal @ off
        for _ in range(PRIOR_ROUNDS):
            held = normal.clone()
            held.diagonal().add_(view.scaled(self._prior, self.prior_group))
            covariance = covariance_of(held)
            before = view
            view = replace(view, prior_scale=self._prior_scales(covariance @ pull, view, covariance))
            if _alike(before, view, PRIOR_SETTLED):
                break
        return view

    def _prior_scales(self, off: Tensor, view: SensorView, covariance: Tensor) -> tuple[float, ...]:
        floor = 1.0 if self.prior_sizes == "widened" else SMALLEST_PRIOR
        return prior_scales(off, self._prior, self.prior_group, view, covariance, floor)

    @cached_property
    def _sized(self) -> bool:
        """Whether there is a prior whose sizes are estimated."""
        return self.prior_sizes != "stated" and bool((self._prior > 0).any())

    def _off(self, point: Tensor) -> Float64[Tensor, " active"]:
        """Distance of the free parameters from where the prior has them."""
        return (point - self.nominal)[self.active]

    def row_weights(self, view: SensorView, sensor: int, rows: slice) -> Float64[Tensor, " poses"]:
        """1 / standard deviation of each row for a sensor, 0 where it saw nothing [1/m or 1/rad]."""
        kind = self.sensors[sensor]
        distance = view.sums[sensor].distance[rows] / view.scale(sensor)
        root = self.loss_of(kind).weight(distance, kind.components).sqrt() / view.variance(sensor) ** 0.5
        if kind.sigma is not None:
            root = root / kind.sigma[rows]
        return torch.where(kind.present[rows], root, 0.0)

    def loss_of(self, sensor: AbstractSensor) -> AbstractLoss:
        """How a sensor's rows count."""
        return CERTAIN_LOSS if sensor.certain else self.loss

    def chunks(self) -> list[slice]:
        """Rows that are worked on together."""
        return [slice(start, start + JACOBIAN_CHUNK) for start in range(0, self.q.shape[0], JACOBIAN_CHUNK)]

    def motion(self, point: Tensor, rows: slice, active: Tensor) -> ToolMotion:
        """Tool pose of some rows and its derivative by some parameters.

        The columns are 0 for base and tool in rows of other frames and targets, and for parameters that do not
        move the tool.
        """
        if self.chunks() == [rows]:
            made_from = (point, self.space, self.q, self.frame, self.target, self._turning)
            motion = self.memory.motion(made_from, lambda: self._whole_motion(point, rows))
        else:
            motion = self._whole_motion(point, rows)
        columns = self.space.motion_columns.to(active.device)
        J = motion.derivative.index_select(0, columns[0, active])
        if not self.space.always_moving:
            f, t = columns[1:, active, None]
            moving = ((f == EVERYWHERE) | (f == self.frame[rows])) & (
                (t == EVERYWHERE) | (t == self.target[rows])
            )
            J = J * moving[:, None, :]
        return ToolMotion(motion.position, motion.rotation, J)

    def _whole_motion(self, point: Tensor, rows: slice) -> ToolMotion:
        """Tool pose of some rows and its derivative by every kind of parameter."""
        dh, bases, tools = self.space.split(point)
        frame = None if len(bases) == 1 else self.frame[rows]
        target = None if len(tools) == 1 else self.target[rows]
        where = (dh.cpu().numpy(), bases.t(), tools.t(), self.q[rows])
        return tool_motion(self.space.robot, *where, self._turning, frame, target)

    def derivative(
        self, sensor: AbstractSensor, motion: ToolMotion, unknowns: Unknowns, rows: slice, active: Tensor
    ) -> Tensor:
        """Derivative of a sensor's values by the parameters that the motion was made for."""
        J = sensor.derivative(motion, unknowns, rows)
        for block in sensor.unknown_derivatives(motion, unknowns, rows):
            positions, owner, column = self.space.positions_of(block.group, active)
            if len(positions):
                theirs = (owner[:, None] == block.owner)[:, None, :]
                J = J.index_add(0, positions, block.derivative[column] * theirs)
        return J

    def combined(self, point: Tensor, view: SensorView) -> Linearisation[Tensor]:
        """Divide the sums by their variances and add the prior."""
        off = self._off(point)
        precision = view.scaled(self._prior, self.prior_group)
        pull = off * precision
        normal, descent = self._data_sums(view)
        normal.diagonal().add_(precision)
        descent.sub_(pull)
        misfit, rounding = 0.0, 0.0
        for k, (sensor, sums) in enumerate(zip(self.sensors, view.sums, strict=True)):
            scale, variance = view.scale(k), view.variance(k)
            cost = self.loss_of(sensor).cost(sums.distance / scale, sensor.components)
            misfit += float(cost.sum()) * scale**2 / variance
            size = self._reach if sensor.unit == "m" else 1.0
            rounding += self.values_measured[k] * (torch.finfo(point.dtype).eps * size) ** 2 / variance
        return Linearisation(point, misfit + float(off.dot(pull)), descent, normal, misfit, rounding, view)

    def _data_sums(
        self, view: SensorView
    ) -> tuple[Float64[Tensor, "active active"], Float64[Tensor, " active"]]:
        """Divide the sums by their variances; the prior is not in it."""
        first, *others = range(len(view.sums))
        normal, descent = (
            sums / view.variance(first) for sums in (view.sums[first].normal, view.sums[first].descent)
        )
        for k in others:
            normal.add_(view.sums[k].normal, alpha=1 / view.variance(k))
            descent.add_(view.sums[k].descent, alpha=1 / view.variance(k))
        return normal, descent

    @cached_property
    def _reach(self) -> float:
        return self.space.robot.reach

    @cached_property
    def _turning(self) -> bool:
        """Whether any sensor needs the tool's rotation."""
        return any(sensor.turning for sensor in self.sensors)

    @cached_property
    def _angular(self) -> bool:
        """Whether any sensor measures angles."""
        return any(sensor.unit == "rad" for sensor in self.sensors)

    @cached_property
    def _prior(self) -> Float64[Tensor, " active"]:
        return self.precision[self.active]

    @cached_property
    def measured_everywhere(self) -> tuple[bool, ...]:
        """Per sensor, whether it has a value in every row."""
        rows = self.q.shape[0]
        return tuple(
            values == rows * sensor.components
            for values, sensor in zip(self.values_measured, self.sensors, strict=True)
        )

    def _sums(
        self, number: int, sigma: float, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> SensorSums:
        """What one sensor contributes in some rows, weighted by its noise."""
        sensor, everywhere = self.sensors[number], self.measured_everywhere[number]
        residual = sensor.residual(motion, unknowns, rows)
        if not everywhere:
            residual = torch.where(sensor.present[rows], residual, 0.0)
        distance = torch.linalg.vector_norm(residual, dim=0)
        if sensor.sigma is not None:
            distance = torch.where(sensor.present[rows], distance / sensor.sigma[rows], 0.0)
        root = self.loss_of(sensor).weight(distance / max(sigma, ALWAYS_GOOD), sensor.components).sqrt()
        if sensor.sigma is not None:
            root = root / sensor.sigma[rows]
        if not everywhere:
            root = torch.where(sensor.present[rows], root, 0.0)
        A = (self.derivative(sensor, motion, unknowns, rows, self.active) * root).flatten(1)
        measured = self.values_measured[number] // sensor.components
        return SensorSums(A @ A.t(), A @ (residual * root).flatten(), residual, distance, measured)


def _alike(before: SensorView, after: SensorView, share: float = SETTLED) -> bool:
    """Whether two estimates of noise and of the prior's sizes differ by less than a share."""
    old, new = (
        (*view.noise, *view.repetition, *view.disagreement, *view.prior_scale) for view in (before, after)
    )
    return all(abs(b / a - 1) < share for a, b in zip(old, new, strict=True))
