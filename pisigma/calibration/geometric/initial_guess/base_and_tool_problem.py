"""Fit of base and tool of a fixed arm as a small least-squares problem."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.least_squares import AbstractLeastSquares, Linearisation
from pisigma.calibration.geometric.problem.noise import SMALLEST_NOISE
from pisigma.files.errors import IdentificationError, Phrase, Place
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.pose import rotation_difference
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.parameter_jacobian import flange_frames
from pisigma.robot.se3 import rotation_from_vector, skew


@dataclass(frozen=True, eq=False)
class BaseToolState:
    """Values of base and tool during the fit.

    Attributes:
        R_base: rotation of the base.
        p_base: position of the base [m].
        R_tool: rotation of the tool.
        points: position of every target in the frame of the last DH row [m].
    """

    R_base: Float64[Tensor, "3 3"]
    p_base: Float64[Tensor, " 3"]
    R_tool: Float64[Tensor, "3 3"]
    points: Float64[Tensor, "targets 3"]


@dataclass(frozen=True, eq=False)
class _View:
    """Normal matrix, right-hand side and cost of positions and of rotations, and their standard deviations."""

    blocks: tuple[tuple[Tensor, Tensor, float], ...]
    noise: tuple[float, float]


@dataclass(frozen=True, eq=False)
class BaseToolProblem(AbstractLeastSquares[BaseToolState]):
    """Least-squares problem of flange poses and measurements.

    The unknowns are the shift [m] and rotation [rad] of the base (about its origin, in the measuring frame), and the
    points (3 per target) [m] and the rotation [rad] of the tool in the frame of the last DH row.

    Attributes:
        R_flange: rotations of the last DH row's frame in the first DH row's frame.
        p_flange: positions of the last DH row's frame in the first DH row's frame [m].
        position: measured positions [m].
        rotation: measured rotations; the identity in rows without one.
        has_rotation: mask of the rows with a measured rotation.
        target: index of every row's target.
        targets: names of the targets.
        sigma_position: standard deviation of every row [m]; None to estimate the scatter.
        sigma_rotation: standard deviation of every row [rad]; None to estimate the scatter.
        free_base: whether to fit the base.
        free_tool: whether to fit the tool.
    """

    R_flange: Float64[Tensor, "rows 3 3"]
    p_flange: Float64[Tensor, "rows 3"]
    position: Float64[Tensor, "rows 3"]
    rotation: Float64[Tensor, "rows 3 3"]
    has_rotation: Bool[Tensor, " rows"]
    target: Int64[Tensor, " rows"]
    targets: tuple[str, ...]
    sigma_position: Float64[Tensor, " rows"] | None
    sigma_rotation: Float64[Tensor, " rows"] | None
    free_base: bool = True
    free_tool: bool = True

    @cached_property
    def has_rotations(self) -> bool:
        """Whether any rotation was measured."""
        return bool(self.has_rotation.any())

    @cached_property
    def active(self) -> Int64[Tensor, " active"]:
        """Indices of the unknowns that are free."""
        unknowns = 9 + 3 * len(self.targets)
        free = torch.zeros(unknowns, dtype=torch.bool)
        free[:6] = self.free_base
        free[6:-3] = self.free_tool
        free[-3:] = self.free_tool and self.has_rotations
        return free.nonzero()[:, 0].to(self.position.device)

    @cached_property
    def step_scale(self) -> Float64[Tensor, " active"]:
        """Typical size of every unknown: 1 mm or 1 mrad."""
        return torch.full((len(self.active),), 1e-3, dtype=torch.float64, device=self.position.device)

    def residuals(self, state: BaseToolState) -> tuple[Float64[Tensor, "rows 3"], Float64[Tensor, "rows 3"]]:
        """Compute measured minus predicted positions [m] and rotation vectors [rad], in the measuring frame."""
        position = self.position_residual(state)
        return position, self.rotation_residual(state) if self.has_rotations else torch.zeros_like(position)

    def position_residual(self, state: BaseToolState) -> Float64[Tensor, "rows 3"]:
        """Compute measured minus predicted positions [m]."""
        return self.position - (self._arm(state) @ state.R_base.mT + state.p_base)

    def rotation_residual(self, state: BaseToolState) -> Float64[Tensor, "rows 3"]:
        """Compute rotation vectors from predicted to measured rotations [rad]; 0 where none was measured."""
        predicted = state.R_base @ self.R_flange @ state.R_tool
        turn = rotation_difference(self.rotation.permute(1, 2, 0), predicted.permute(1, 2, 0))
        return (turn * self.has_rotation).t()

    def linearise(
        self, point: BaseToolState, with_noise_of: Linearisation[BaseToolState] | None
    ) -> Linearisation[BaseToolState]:
        """Sum the normal equations of positions and of rotations separately."""
        noise = (1.0, 1.0) if with_noise_of is None else _view_of(with_noise_of).noise
        R_base_flange = point.R_base @ self.R_flange
        blocks = [(self._shifts(point, R_base_flange), self.position_residual(point), self.sigma_position)]
        if self.has_rotations:
            blocks.append((self._turns(R_base_flange), self.rotation_residual(point), self.sigma_rotation))
        sums = []
        for J, residual, sigma in blocks:
            A, r = J[..., self.active].flatten(0, 1), residual.flatten()
            if sigma is not None:
                weight = (1 / sigma).repeat_interleave(3)
                A, r = A * weight[:, None], r * weight
            sums.append((A.mT @ A, A.mT @ r, float(r @ r)))
        return self._combined(point, _View(tuple(sums), noise))

    def with_updated_noise(
        self, linearisation: Linearisation[BaseToolState]
    ) -> tuple[Linearisation[BaseToolState], bool]:
        """Weight positions and rotations by the inverse of their scatter if no standard deviation is stated."""
        view = _view_of(linearisation)
        values = (3 * len(self.position), 3 * self._rotations)
        stated = (self.sigma_position is not None, self.sigma_rotation is not None)
        noise = [1.0, 1.0]
        for k, part in enumerate(view.blocks):
            if not stated[k]:
                noise[k] = max((part[2] / values[k]) ** 0.5, SMALLEST_NOISE)
        settled = all(abs(new / old - 1) < 1e-2 for new, old in zip(noise, view.noise, strict=True))
        return self._combined(linearisation.point, _View(view.blocks, (noise[0], noise[1]))), settled

    def _combined(self, point: BaseToolState, view: "_View") -> Linearisation[BaseToolState]:
        noise = view.noise[: len(view.blocks)]
        pairs = list(zip(view.blocks, noise, strict=True))
        normal = torch.stack([part[0] / s**2 for part, s in pairs]).sum(0)
        descent = torch.stack([part[1] / s**2 for part, s in pairs]).sum(0)
        cost = descent.new_tensor(sum(part[2] / s**2 for part, s in pairs))
        rounding = descent.new_tensor(sum(3 * len(self.position) * (self._rounding / s) ** 2 for s in noise))
        return Linearisation(point, cost, descent, normal, cost, rounding, view)

    def apply_step(self, point: BaseToolState, step: Float64[Tensor, " active"]) -> BaseToolState:
        """Return base and tool after a step."""
        full = step.new_zeros(9 + 3 * len(self.targets)).index_copy(0, self.active, step)
        return BaseToolState(
            R_base=rotation_from_vector(full[3:6]) @ point.R_base,
            p_base=point.p_base + full[:3],
            R_tool=rotation_from_vector(full[-3:]) @ point.R_tool,
            points=point.points + full[6:-3].reshape(-1, 3),
        )

    def _arm(self, state: BaseToolState) -> Tensor:
        """Compute the positions of the targets in the first DH row's frame."""
        return self.p_flange + (self.R_flange @ state.points[self.target, :, None])[..., 0]

    @cached_property
    def _rotations(self) -> int:
        return int(self.has_rotation.sum())

    @cached_property
    def _rounding(self) -> float:
        """Rounding error of a position [m]."""
        return 2 * torch.finfo(self.position.dtype).eps * (float(self.p_flange.abs().max()) + 1e-3)

    def _shifts(self, state: BaseToolState, R_base_flange: Tensor) -> Tensor:
        """Compute the derivative of the positions with respect to all unknowns."""
        rows, targets = self.position.shape[0], len(self.targets)
        J = self.position.new_zeros((rows, 3, 9 + 3 * targets))
        J[..., :3] = torch.eye(3, dtype=J.dtype, device=J.device)
        J[..., 3:6] = -skew(self._arm(state) @ state.R_base.mT)
        own = R_base_flange
        if targets > 1:
            of_target = torch.nn.functional.one_hot(self.target, targets).to(J.dtype)
            own = (own[:, :, None, :] * of_target[:, None, :, None]).reshape(rows, 3, 3 * targets)
        J[..., 6:-3] = own
        return J

    def _turns(self, R_base_flange: Tensor) -> Tensor:
        """Compute the derivative of the rotations with respect to all unknowns."""
        J = self.position.new_zeros((self.position.shape[0], 3, 9 + 3 * len(self.targets)))
        rotated = self.has_rotation[:, None, None]
        J[..., 3:6] = rotated * torch.eye(3, dtype=J.dtype, device=J.device)
        J[..., -3:] = rotated * R_base_flange
        return J


def _view_of(linearisation: Linearisation[BaseToolState]) -> _View:
    assert isinstance(linearisation.problem_data, _View)
    return linearisation.problem_data


def build_base_and_tool_problem(
    robot: Robot, measurements: Measurements, free_base: bool = True, free_tool: bool = True
) -> BaseToolProblem:
    """Build the problem from the rows with positions.

    Raises:
        IdentificationError: there are no positions, several frames, or too few values for the unknowns.
    """
    if measurements.position is None:
        raise IdentificationError(
            expected="measured positions or poses for base and tool",
            value=Phrase("none"),
            at=Place(measurements.source),
            remedy="give the columns x_mm, y_mm, z_mm",
        )
    frames = sorted(set(measurements.frame))
    if len(frames) > 1:
        raise IdentificationError(
            f"expected one measuring frame, got {len(frames)}: {', '.join(frames)}",
            expected="one measuring frame",
            value=len(frames),
            at=Place(measurements.source),
            remedy="give the rows of one frame at a time",
        )
    keep = torch.isfinite(measurements.position).all(-1)
    names = measurements.target or ("",) * measurements.q.shape[0]
    kept = [name for name, good in zip(names, keep.tolist(), strict=True) if good]
    targets = tuple(dict.fromkeys(kept))
    numbers = {name: number for number, name in enumerate(targets)}
    robot.check_joint_count(measurements.q.shape[1])
    R_flange, p_flange = flange_frames(robot, measurements.q[keep])
    rotation, rotated = _rotations(measurements, keep)
    problem = BaseToolProblem(
        R_flange=R_flange,
        p_flange=p_flange,
        position=measurements.position[keep],
        rotation=rotation,
        has_rotation=rotated,
        target=torch.tensor([numbers[name] for name in kept], dtype=torch.int64, device=keep.device),
        targets=targets,
        sigma_position=_given(measurements.sigma_position, keep, torch.ones_like(rotated)),
        sigma_rotation=_given(measurements.sigma_rotation, keep, rotated),
        free_base=free_base,
        free_tool=free_tool,
    )
    _check_size(problem, measurements)
    return problem


def _rotations(measurements: Measurements, keep: Tensor) -> tuple[Tensor, Tensor]:
    """Return the measured rotations of the rows to keep (or the identity), and the mask of measured rotations."""
    eye = torch.eye(3, dtype=measurements.q.dtype, device=measurements.q.device)
    if measurements.rotation is None:
        count = int(keep.sum())
        return eye.expand(count, 3, 3), torch.zeros(count, dtype=torch.bool, device=measurements.q.device)
    rotation = measurements.rotation[keep]
    rotated = torch.isfinite(rotation).all(-1).all(-1)
    return torch.where(rotated[:, None, None], rotation, eye), rotated


def _given(sigma: Tensor | None, keep: Tensor, used: Tensor) -> Tensor | None:
    """Return the standard deviations of the rows to keep; None if not all used values state one."""
    if sigma is None or not bool(torch.isfinite(sigma[keep][used]).all()):
        return None
    return torch.where(used, sigma[keep], 1.0)


def _check_size(problem: BaseToolProblem, measurements: Measurements) -> None:
    rows = problem.position.shape[0]
    values = 3 * rows + 3 * int(problem.has_rotation.sum())
    if values < len(problem.active) or rows == 0:
        raise IdentificationError(
            f"expected at least {len(problem.active)} values for the unknowns of base and tool, got {values} "
            f"values from {rows} rows with positions",
            expected=f"at least {len(problem.active)} values",
            value=values,
            at=Place(measurements.source),
            remedy="measure more poses, spread over the workspace",
        )
