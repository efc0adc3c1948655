"""The calibration as a least-squares problem: normal equations summed over chunks of poses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.identification.jacobian import JACOBIAN_CHUNK, ToolMotion, motion_order, tool_motion
from pisigma.identification.least_squares import AbstractLeastSquares, Linearisation
from pisigma.identification.loss import AbstractLoss
from pisigma.identification.parameters import ParameterSpace
from pisigma.identification.sensors import AbstractSensor

SMALLEST_NOISE = 1e-14
"""[m or rad] Floor of the estimated noise: what rounding does to a pose."""
ALWAYS_GOOD = 1e-10
"""[m or rad] Rows nearer to their prediction than this never count as wrong."""


@dataclass(frozen=True, eq=False)
class SensorSums:
    """What one sensor contributes at one point, before division by its noise's variance.

    Attributes:
        normal: `Σ w J J^T / sigma_row²` over its rows.
        descent: `Σ w J r / sigma_row²`.
        residual: measured minus predicted, 0 where nothing was seen [m or rad].
        distance: length of the residual over sigma_row, 0 where nothing was seen.
    """

    normal: Float64[Tensor, "active active"]
    descent: Float64[Tensor, " active"]
    residual: Float64[Tensor, "components rows"]
    distance: Float64[Tensor, " rows"]


@dataclass(frozen=True, eq=False)
class SensorView:
    """All sensors at one point.

    Attributes:
        sums: per sensor.
        noise: per sensor, its standard deviation [m or rad], or a factor of 1 or more where the rows give their own.
        repetition: per sensor, 1 or more: by how much repeats of a pose tell less than so many poses, because what
            the model gets wrong there is the same in all of them.
        widening: 1 or more, of the prior's standard deviations, for lengths and for angles.
    """

    sums: tuple[SensorSums, ...]
    noise: tuple[float, ...]
    repetition: tuple[float, ...]
    widening: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True, eq=False)
class CalibrationProblem(AbstractLeastSquares[Tensor]):
    """Rows, sensors, the parameters that are free and what is known of them.

    Attributes:
        space: the parameters; a point is a vector of all of them.
        q: joint values [rad or m] of the rows.
        frame: index of every row's frame.
        target: index of every row's target.
        sensors: what was measured in the rows.
        loss: how rows far from their prediction count.
        nominal: values of all parameters that the prior is about.
        precision: 1 / variance of their errors, 0 where nothing is known.
        active: indices of the free parameters.
        pose: number of every row's pose (joint values, frame, target), None where no pose is repeated.
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

    @property
    def step_scale(self) -> Float64[Tensor, " active"]:
        """1 mm and 1 mrad."""
        return torch.from_numpy(self.space.usual_errors)[self.active].to(self.q.device)

    @cached_property
    def values_seen(self) -> tuple[int, ...]:
        """Number of values of every sensor."""
        return tuple(int(sensor.seen.sum()) * sensor.components for sensor in self.sensors)

    def with_active(self, active: Sequence[int]) -> "CalibrationProblem":
        """The same with other free parameters."""
        return replace(self, active=torch.tensor(sorted(active), dtype=torch.int64, device=self.q.device))

    def without_prior(self) -> "CalibrationProblem":
        """The same with nothing known beforehand."""
        return replace(self, precision=torch.zeros_like(self.precision))

    def moved(self, point: Tensor, step: Tensor) -> Tensor:
        """The parameters after a step of the free ones."""
        return point.index_add(0, self.active, step)

    def linearise(self, point: Tensor, like: Linearisation[Tensor] | None) -> Linearisation[Tensor]:
        """Sum up the normal equations; rows are weighted by the noise of `like`."""
        noise = view_of(like).noise if like is not None else (float("inf"),) * len(self.sensors)
        size = len(self.active)
        sums = [
            SensorSums(
                normal=point.new_zeros((size, size)),
                descent=point.new_zeros(size),
                residual=point.new_zeros((sensor.components, self.q.shape[0])),
                distance=point.new_zeros(self.q.shape[0]),
            )
            for sensor in self.sensors
        ]
        for rows in self.chunks():
            motion = self.motion(point, rows)
            for sensor, total, sigma in zip(self.sensors, sums, noise, strict=True):
                self._add(sensor, total, sigma, motion, rows)
        ones = (1.0,) * len(noise)
        if like is None:
            return self._combined(point, SensorView(tuple(sums), ones, ones))
        return self._combined(point, replace(view_of(like), sums=tuple(sums)))

    def renewed(self, linearisation: Linearisation[Tensor]) -> tuple[Linearisation[Tensor], bool]:
        """Estimate every sensor's noise from its residuals, robustly, less what the parameters used up."""
        view = view_of(linearisation)
        return self._with_noise(
            linearisation,
            [
                self.loss.scale(sums.distance[sensor.seen], sensor.components, used)
                for sensor, sums, used in zip(self.sensors, view.sums, self.used(linearisation), strict=True)
            ],
        )

    def refined(self, linearisation: Linearisation[Tensor]) -> Linearisation[Tensor]:
        """The same with the noise estimated from all good rows, for the end of a search."""
        view = view_of(linearisation)
        noise = [
            self.loss.deviation(sums.distance[sensor.seen], sensor.components, used, max(sigma, ALWAYS_GOOD))
            for sensor, sums, used, sigma in zip(
                self.sensors, view.sums, self.used(linearisation), view.noise, strict=True
            )
        ]
        return self._with_noise(linearisation, noise)[0]

    def used(self, linearisation: Linearisation[Tensor]) -> tuple[float, ...]:
        """How many values of every sensor the estimated parameters use up (Förstner 1979); the prior spares some."""
        view = view_of(linearisation)
        covariance = covariance_of(linearisation.normal)
        return tuple(
            float((sums.normal * covariance).sum()) / (sigma**2 * repetition)
            for sums, sigma, repetition in zip(view.sums, view.noise, view.repetition, strict=True)
        )

    def _with_noise(
        self, linearisation: Linearisation[Tensor], found: Sequence[float]
    ) -> tuple[Linearisation[Tensor], bool]:
        """The same with other noise, and whether it is nearly the old one."""
        view = view_of(linearisation)
        noise = tuple(
            max(sigma, SMALLEST_NOISE if sensor.sigma is None else 1.0)
            for sensor, sigma in zip(self.sensors, found, strict=True)
        )
        repetition = tuple(
            self._repetition(sensor, sums, sigma, used)
            for sensor, sums, sigma, used in zip(
                self.sensors, view.sums, noise, self.used(linearisation), strict=True
            )
        )
        widening = self._widening(linearisation)
        old = (*view.noise, *view.repetition, *view.widening)
        settled = all(abs(b / a - 1) < 1e-3 for a, b in zip(old, (*noise, *repetition, *widening), strict=True))
        return self._combined(linearisation.point, SensorView(view.sums, noise, repetition, widening)), settled

    def _widening(self, linearisation: Linearisation[Tensor]) -> tuple[float, float]:
        """How much larger than stated the errors turn out, for lengths and angles (MacKay 1992, eq. 4.7).

        Every parameter counts by how much of it the data tell. Smaller errors do not tighten the prior.
        """
        precision = self._precision(view_of(linearisation).widening)
        told = 1 - precision * covariance_of(linearisation.normal).diagonal()
        stated = self.precision[self.active]
        square = (linearisation.point - self.nominal)[self.active].square() * stated
        found = []
        for lengths in (True, False):
            chosen = (self._lengths[self.active] == lengths) & (stated > 0)
            total = float(told[chosen].sum())
            found.append(max(float(square[chosen].sum()) / total, 1.0) ** 0.5 if total > 1 else 1.0)
        return found[0], found[1]

    def _precision(self, widening: tuple[float, float]) -> Tensor:
        """1 / variance of the free parameters' errors by the prior, as far as it was widened."""
        length, angle = (1 / factor**2 for factor in widening)
        return self.precision[self.active] * torch.where(self._lengths[self.active], length, angle)

    @cached_property
    def _lengths(self) -> Tensor:
        """Which parameters are lengths."""
        units = [parameter.unit == "m" for parameter in self.space.parameters]
        return torch.tensor(units, device=self.q.device)

    def _repetition(self, sensor: AbstractSensor, sums: SensorSums, sigma: float, used: float) -> float:
        """Variance of the poses' mean residuals over what independent rows would give (Kish's design effect)."""
        if self.pose is None:
            return 1.0
        weight = self.loss.weight(sums.distance / max(sigma, ALWAYS_GOOD), sensor.components) * sensor.seen
        if sensor.sigma is not None:
            weight = torch.where(sensor.seen, weight / sensor.sigma.square(), 0.0)
        poses = int(self.pose.max()) + 1
        total = weight.new_zeros(poses).index_add(0, self.pose, weight)
        sum_of = sums.residual.new_zeros((sensor.components, poses)).index_add(1, self.pose, sums.residual * weight)
        seen = total > 0
        distance = (sum_of[:, seen].norm(dim=0)) / total[seen].sqrt()
        between = self.loss.deviation(distance, sensor.components, used, max(sigma, ALWAYS_GOOD) * 1e9)
        return max((between / sigma) ** 2, 1.0)

    def row_weights(self, view: SensorView, sensor: int, rows: slice) -> Float64[Tensor, " poses"]:
        """1 / standard deviation that each row counts with for a sensor, 0 where it saw nothing [1/m or 1/rad]."""
        kind, sigma = self.sensors[sensor], view.noise[sensor]
        distance = view.sums[sensor].distance[rows] / max(sigma, ALWAYS_GOOD)
        root = self.loss.weight(distance, kind.components).sqrt() / (sigma * view.repetition[sensor] ** 0.5)
        if kind.sigma is not None:
            root = root / kind.sigma[rows]
        return torch.where(kind.seen[rows], root, 0.0)

    def chunks(self) -> list[slice]:
        """Rows that are worked on together."""
        return [slice(start, start + JACOBIAN_CHUNK) for start in range(0, self.q.shape[0], JACOBIAN_CHUNK)]

    def motion(self, point: Tensor, rows: slice) -> ToolMotion:
        """Tool pose of some rows and its derivative by all parameters of one frame and one target."""
        dh, bases, tools = self.space.split(point)
        base = bases.t() if len(bases) == 1 else bases.t()[:, self.frame[rows]]
        tool = tools.t() if len(tools) == 1 else tools.t()[:, self.target[rows]]
        turning = any(sensor.turning for sensor in self.sensors)
        return tool_motion(self.space.robot, dh.cpu().numpy(), base, tool, self.q[rows], turning)

    def spread(self, derivative: Tensor, rows: slice, active: Tensor) -> Tensor:
        """Columns of `active` parameters: those of base and tool are 0 in rows of other frames and targets."""
        columns, frame, target = self._columns
        J = derivative.index_select(0, columns[active])
        if len(self.space.frames) > 1 or len(self.space.targets) > 1:
            f, t = frame[active][:, None], target[active][:, None]
            own = ((f < 0) | (f == self.frame[rows])) & ((t < 0) | (t == self.target[rows]))
            J = J * own[:, None, :]
        return J

    @cached_property
    def _columns(self) -> tuple[Tensor, Tensor, Tensor]:
        """Per parameter: its column in a tool motion, its frame and its target (-1: all)."""
        order = motion_order(len(self.space.robot.rows))
        arm, frames, targets = order[:-12], len(self.space.frames), len(self.space.targets)
        columns = arm + order[-12:-6] * frames + order[-6:] * targets
        frame = [-1] * len(arm) + [f for f in range(frames) for _ in range(6)] + [-1] * 6 * targets
        target = [-1] * (len(arm) + 6 * frames) + [t for t in range(targets) for _ in range(6)]
        found = torch.tensor([columns, frame, target], device=self.q.device)
        return found[0], found[1], found[2]

    def _add(
        self, sensor: AbstractSensor, sums: SensorSums, sigma: float, motion: ToolMotion, rows: slice
    ) -> None:
        """Add one sensor's part of some rows, in place."""
        seen = sensor.seen[rows]
        residual = torch.where(seen, sensor.residual(motion, rows), 0.0)
        distance = residual.norm(dim=0)
        root = seen.to(residual.dtype)
        if sensor.sigma is not None:
            distance = torch.where(seen, distance / sensor.sigma[rows], 0.0)
            root = torch.where(seen, 1 / sensor.sigma[rows], 0.0)
        root = root * self.loss.weight(distance / max(sigma, ALWAYS_GOOD), sensor.components).sqrt()
        A = (self.spread(sensor.derivative(motion), rows, self.active) * root).flatten(1)
        sums.normal.addmm_(A, A.t())
        sums.descent.addmv_(A, (residual * root).flatten())
        sums.residual[:, rows] = residual
        sums.distance[rows] = distance

    def _combined(self, point: Tensor, view: SensorView) -> Linearisation[Tensor]:
        """Divide by the variances, add the prior."""
        off = (point - self.nominal)[self.active]
        precision = self._precision(view.widening)
        normal, descent, misfit, rounding = torch.diag(precision), -off * precision, 0.0, 0.0
        for k, (sensor, sums) in enumerate(zip(self.sensors, view.sums, strict=True)):
            scale, variance = max(view.noise[k], ALWAYS_GOOD), view.noise[k] ** 2 * view.repetition[k]
            row_costs = self.loss.cost(sums.distance / scale, sensor.components)
            misfit += float(row_costs.sum()) * scale**2 / variance
            normal = normal + sums.normal / variance
            descent = descent + sums.descent / variance
            size = self.space.robot.reach if sensor.unit == "m" else 1.0
            rounding += self.values_seen[k] * (2 * torch.finfo(point.dtype).eps * size) ** 2 / variance
        cost = misfit + float((off.square() * precision).sum())
        return Linearisation(point, cost, descent, normal, misfit, rounding, view)


def view_of(linearisation: Linearisation[Tensor]) -> SensorView:
    """The sensors' part of a linearisation that a `CalibrationProblem` made."""
    assert isinstance(linearisation.detail, SensorView)
    return linearisation.detail


def covariance_of(normal: Float64[Tensor, "active active"]) -> Float64[Tensor, "active active"]:
    """Inverse of a normal matrix, with column scaling; directions that it does not hold get no variance."""
    diagonal = normal.diagonal()
    scale = torch.where(diagonal > 0, diagonal, torch.ones_like(diagonal)).rsqrt()
    scaled = normal * scale * scale[:, None]
    factor, failed = torch.linalg.cholesky_ex(scaled)
    if not failed and float(factor.diagonal().min()) > 1e-6:
        inverse = torch.cholesky_inverse(factor)
    else:
        inverse = torch.linalg.pinv(scaled, rtol=1e-12, hermitian=True)
    return inverse * scale * scale[:, None]
