"""Initial guess of tools and frames from distances: wires and pairs of poses."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.initial_guess.base_and_tool_closed_form import fit_base_to_points
from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.files.errors import ImplausibleError, Place
from pisigma.measurement.csv.columns import MISNAMED_UNITS
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.distance import (
    MAX_NOMINAL_ERROR,
    MIN_DISTANCES,
    anchor_from_distances,
    stated_position,
)
from pisigma.measurement.sensors.sensor import distinct_names, indices_of_names
from pisigma.robot.description import Robot
from pisigma.robot.robot_class import RobotClass
from pisigma.robot.se3 import rotation_from_zyx, zyx_from_rotation

MAX_ITERATIONS = 60
_CONVERGENCE_TOLERANCE = 1e-6
"""Length of a step at convergence [m]."""
_WEAK = 0.01
"""Weight per row of the nominal tool, which determines directions that distances hardly determine."""
_HELD = 1e4
"""Weight per row of the nominal tool if the tool is known."""
_OUTLYING = 3.0
"""Ratio of an error to the median error above which the weight of a distance is reduced, so that single mistakes
have little effect."""
_FAR_START = 0.3
"""Distance of further starts from the nominal tool, in both directions of its axes, as a share of the reach."""
_MAX_SHIFT, _MAX_CLEAR_SHIFT = 0.35, 1.0
"""Largest distance of a tool from the nominal tool, as a share of the reach: in general, and if many distances agree
clearly with it."""
_MANY_TIMES = 3
"""Number of distances per unknown above which a tool is accepted at a larger distance from the nominal tool."""
_DOUBTFUL = 0.01
"""Ratio of the median error of the distances to the median motion of the tool above which other units are tried."""
_COLLAPSED = 0.25
"""Largest share of the errors that may remain in another unit."""
_MAX_WRONG_SHARE = 0.25
"""Share of the distances that may be off by more than `MAX_NOMINAL_ERROR`, or by the usual zeros of servos."""


@dataclass(frozen=True, eq=False)
class _Distances:
    """Distances of one target's rows from anchors, or from the other rows of their pairs (anchor -1).

    The length of `R · tool + p - anchor` is measured; for pairs, R and p are the differences between the two rows.
    """

    R: Float64[Tensor, "rows 3 3"]
    p: Float64[Tensor, "rows 3"]
    anchor: Int64[Tensor, " rows"]
    measured: Float64[Tensor, "*batch rows"]

    @property
    def unknowns(self) -> int:
        """Number of unknowns: three of the tool, and four of every anchor with its zero offset."""
        return 3 + 4 * (int(self.anchor.max()) + 1)

    def points(self, tool: Float64[Tensor, "*batch 3"]) -> Float64[Tensor, "*batch rows 3"]:
        """Compute the positions of a tool, or their differences in pairs [m]."""
        return (self.R @ tool[..., None, :, None])[..., 0] + self.p

    def start(self, tool: Float64[Tensor, "*batch 3"]) -> Float64[Tensor, "*batch unknowns"]:
        """Return a tool and the anchors that are fitted with this tool."""
        points = self.points(tool)
        anchors = [
            anchor_from_distances(points[..., self.anchor == k, :], self.measured[..., self.anchor == k])
            for k in range((self.unknowns - 3) // 4)
        ]
        return torch.cat([tool, *anchors], -1)

    def linearised(
        self, unknown: Float64[Tensor, "*batch unknowns"]
    ) -> tuple[Float64[Tensor, "*batch rows"], Float64[Tensor, "*batch rows unknowns"]]:
        """Return measured minus predicted distances [m], and the derivatives of the predicted distances."""
        wires = (self.anchor >= 0).nonzero()[:, 0]
        away, zero = self.points(unknown[..., :3]), torch.zeros_like(self.measured)
        anchors = unknown[..., 3:].reshape(*unknown.shape[:-1], -1, 4)[..., self.anchor[wires], :]
        away[..., wires, :] -= anchors[..., :3]
        zero[..., wires] = anchors[..., 3]
        length = away.norm(dim=-1).clamp(min=1e-9)
        direction = away / length[..., None]
        J = torch.zeros(*length.shape, unknown.shape[-1], dtype=torch.float64)
        J[..., :3] = (direction[..., None, :] @ self.R)[..., 0, :]
        columns = 3 + 4 * self.anchor[wires, None] + torch.arange(4)
        anchor_jacobian = torch.cat([-direction, torch.ones_like(length)[..., None]], -1)
        J[..., wires[:, None], columns] = anchor_jacobian[..., wires, :]
        return self.measured - length - zero, J

    def fitted(
        self,
        factors: Float64[Tensor, " units"],
        nominal_tool: Float64[Tensor, " 3"],
        held: bool,
        reach: float,
    ) -> tuple[Float64[Tensor, "units 3"], Float64[Tensor, "units rows"]]:
        """Fit the tool to the distances times each factor, from starts near to and far from the nominal tool.

        Returns:
            For every factor, the tool and the residuals [m].
        """
        in_units = replace(self, measured=factors[:, None] * self.measured)
        tool, residual = in_units._refined(nominal_tool.expand(len(factors), 3), nominal_tool, held)
        doubtful = self.is_doubtful(tool, residual).nonzero()[:, 0]
        if held or not len(doubtful):
            return tool, residual
        ways = torch.cat([torch.eye(3), -torch.eye(3)]).double() * _FAR_START * reach
        several = replace(self, measured=in_units.measured[doubtful, None].expand(-1, len(ways), -1))
        far = several._refined((nominal_tool + ways).expand(len(doubtful), -1, -1), nominal_tool, held)
        for unit, tools, residuals in zip(doubtful.tolist(), *far, strict=True):
            for other in zip(tools, residuals, strict=True):
                best = tool[unit], residual[unit]
                if bool(self.is_doubtful(*best)):
                    tool[unit], residual[unit] = min(
                        best, other, key=lambda fit: float(fit[1].abs().median())
                    )
        return tool, residual

    def is_doubtful(
        self, tool: Float64[Tensor, "*batch 3"], residual: Float64[Tensor, "*batch rows"]
    ) -> Bool[Tensor, "*batch"]:
        """Return whether the median error is large relative to the motion of the tool."""
        points = self.points(tool)
        motion = (points - points.mean(-2, keepdim=True)).norm(dim=-1).median(-1).values
        doubtful: Tensor = residual.abs().median(-1).values > _DOUBTFUL * motion
        return doubtful

    def _refined(
        self, start: Float64[Tensor, "*batch 3"], nominal_tool: Float64[Tensor, " 3"], held: bool
    ) -> tuple[Float64[Tensor, "*batch 3"], Float64[Tensor, "*batch rows"]]:
        """Refine a batch of tools by robust Levenberg-Marquardt steps; return the tools and the residuals [m]."""
        unknown = self.start(start)
        pull, nominal = torch.zeros(2, unknown.shape[-1]).double()
        pull[:3], nominal[:3] = (_HELD if held else _WEAK) ** 2 * self.measured.shape[-1], nominal_tool
        damping = torch.full_like(unknown[..., :1], 1e-3)
        residual, J = self.linearised(unknown)
        for _ in range(MAX_ITERATIONS):
            limit = _OUTLYING * residual.abs().median(-1, keepdim=True).values.clamp(min=1e-9)
            weighted = J.mT * (limit / residual.abs()).clamp(max=1.0)[..., None, :]  # weights of Huber's loss
            normal = weighted @ J + torch.diag(pull)
            gradient = weighted @ residual[..., None] - (pull * (unknown - nominal))[..., None]
            scale = normal.diagonal(dim1=-2, dim2=-1).clamp(min=1e-12)
            step = torch.linalg.solve(normal + torch.diag_embed(damping * scale), gradient)[..., 0]
            trial_residual, trial_J = self.linearised(unknown + step)
            better = (_cost(trial_residual, limit) < _cost(residual, limit))[..., None]
            unknown = torch.where(better, unknown + step, unknown)
            residual = torch.where(better, trial_residual, residual)
            J = torch.where(better[..., None], trial_J, J)
            damping = torch.where(better, (damping / 10).clamp(min=1e-9), damping * 10)
            if float(step.abs().max()) < _CONVERGENCE_TOLERANCE:
                break
        return unknown[..., :3], residual


def tools_from_distances(
    space: ParameterSpace,
    measurements: Measurements,
    T_flange: Float64[Tensor, "rows 4 4"],
    tools: Mapping[str, np.ndarray],
    free_tool: bool,
) -> dict[str, np.ndarray]:
    """Add guesses of tools that have none, by fitting them to wires and pairs together with the anchors.

    Distances between points of one arm do not depend on the base. Single wrong distances have little effect.

    Args:
        space: names and robot.
        measurements: the rows; those of pairs come first, next to each other.
        T_flange: nominal poses of the flange in the base of the robot.
        tools: guesses by other sensors.
        free_tool: whether to identify tools.

    Raises:
        ImplausibleError: distances do not fit with any tool, for example because of a wrong unit.
    """
    tools, nominal_tool, reach = dict(tools), space.robot.tool, space.robot.reach
    for name in space.targets:
        distances = _distances_of(measurements, T_flange, name)
        if len(distances.measured) < MIN_DISTANCES:
            continue
        held = name in tools or not free_tool
        position = torch.from_numpy(tools.get(name, nominal_tool)[:3].copy())
        tool, residual = (one[0] for one in distances.fitted(torch.ones(1).double(), position, held, reach))
        _refuse_other_units(space.robot, distances, (tool, residual), (position, held), measurements.source)
        limit = max(MAX_NOMINAL_ERROR, RobotClass.from_robot(space.robot).prior_sizes.joint_offset) * reach
        off = int((residual.abs() > limit).sum())
        if off > _MAX_WRONG_SHARE * len(residual):
            raise ImplausibleError(
                f"{off} of {len(residual)} distances differ by more than {limit * 1e3:.3g} mm from those of robot "
                f"'{space.robot.name}' at these joint values, whatever the tool",
                expected="distances of this robot",
                value=off,
                at=Place(measurements.source),
                remedy="check that distances and joint values belong to the same rows, and that this robot was "
                "measured",
            )
        clear = len(residual) >= _MANY_TIMES * distances.unknowns and not distances.is_doubtful(
            tool, residual
        )
        largest = (_MAX_CLEAR_SHIFT if clear else _MAX_SHIFT) * reach
        if not held and float((tool - position).norm()) <= largest:
            tools[name] = np.concatenate([tool.numpy(), nominal_tool[3:]])
    return tools


def base_from_anchors(
    measurements: Measurements,
    frame: str,
    tip: Float64[Tensor, "rows 3"],
    nominal_base: Float64[np.ndarray, " 6"],
) -> Float64[np.ndarray, " 6"]:
    """Compute T_frame_robot from anchors at stated positions; wires determine their positions in the robot's base.

    Args:
        measurements: the rows.
        frame: name of the frame.
        tip: nominal positions of the tip in the base of the robot [m].
        nominal_base: x, y, z [m], roll, pitch, yaw [rad] of the nominal base, for what the anchors do not determine.
    """
    seen, stated = [], []
    for name in distinct_names(measurements.anchor):
        rows = [
            row
            for row, anchor in enumerate(measurements.anchor or ())
            if anchor == name and measurements.frame[row] == frame
        ]
        place = stated_position(measurements, rows[0]) if rows else None
        if place is not None and len(rows) >= MIN_DISTANCES and measurements.distance is not None:
            seen.append(anchor_from_distances(tip[rows], measurements.distance.cpu()[rows])[:3])
            stated.append(place.cpu())
    if not seen:
        return nominal_base
    R, p = fit_base_to_points(
        torch.stack(seen), torch.stack(stated), rotation_from_zyx(tip.new_tensor(nominal_base[3:]))
    )
    return torch.cat([p, zyx_from_rotation(R)]).numpy()


def _refuse_other_units(
    robot: Robot,
    distances: _Distances,
    fit: tuple[Float64[Tensor, " 3"], Float64[Tensor, " rows"]],
    start: tuple[Float64[Tensor, " 3"], bool],
    source: str,
) -> None:
    """Refuse distances that fit far better in another unit; errors are compared in the unit of the measurements.

    Raises:
        ImplausibleError: the distances fit far better in another unit.
    """
    if not distances.is_doubtful(*fit):
        return
    typical = float(fit[1].abs().median())
    factors = torch.tensor([factor for factor, _, _ in MISNAMED_UNITS]).double()
    misses = distances.fitted(factors, *start, robot.reach)[1].abs().median(-1).values.tolist()
    miss, (factor, are, named) = min(
        zip(misses, MISNAMED_UNITS, strict=True), key=lambda one: one[0] / one[1][0]
    )
    if miss < MAX_NOMINAL_ERROR * robot.reach and miss / factor < _COLLAPSED * typical:
        raise ImplausibleError(
            f"expected distances of robot '{robot.name}' at these joint values, got {are} labelled as {named}: the "
            f"median error is {typical * 1e3:.3g} mm, and {miss * 1e3:.3g} mm for distances multiplied by "
            f"{factor:.4g}",
            expected=f"distances in {named}",
            value=are,
            at=Place(source),
            remedy="correct the unit in the column names",
        )


def _distances_of(measurements: Measurements, T: Tensor, target: str) -> _Distances:
    """Collect wires with enough distances, and pairs whose rows both have the target."""
    R, p = T[:, :3, :3], T[:, :3, 3]
    if measurements.distance is None:
        return _Distances(R[:0], p[:0], torch.zeros(0, dtype=torch.int64), p[:0, 0])
    distance = measurements.distance.cpu()
    own = torch.tensor([name == target for name in measurements.target]) & torch.isfinite(distance)
    number = indices_of_names(measurements.anchor, distinct_names(measurements.anchor), measurements.rows)
    # An anchor has four unknowns (position and zero offset), so few distances say nothing about the tool.
    known, counts = torch.unique(number[own & (number >= 0)], return_counts=True)
    wires = own & torch.isin(number, known[counts >= MIN_DISTANCES])
    anchor = torch.unique(number[wires], return_inverse=True)[1]
    # The rows of pairs come first, the two rows of a pair after each other.
    first = torch.arange(0, 2 * len(distinct_names(measurements.pair)), 2)
    first = first[own[first] & own[first + 1]]
    return _Distances(
        torch.cat([R[wires], R[first] - R[first + 1]]),
        torch.cat([p[wires], p[first] - p[first + 1]]),
        torch.cat([anchor, torch.full_like(first, -1)]),
        torch.cat([distance[wires], distance[first]]),
    )


def _cost(residual: Tensor, limit: Tensor) -> Tensor:
    """Compute Huber's cost, which is quadratic up to a limit and then linear."""
    size = residual.abs()
    return torch.where(size <= limit, size.square(), 2 * limit * size - limit.square()).sum(-1)
