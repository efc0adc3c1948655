"""The initial guess by wires and pairs of poses: of tools, before their distances are judged, and of frames."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.initial_guess.base_and_tool_closed_form import base_by_points
from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.files.errors import ImplausibleError
from pisigma.measurement.csv.columns import MISNAMED_UNITS
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.anchor import FEWEST, LARGEST_MISS, anchor_from_distances, stated_position
from pisigma.measurement.sensors.sensor import names_of, numbers_of
from pisigma.robot.description import Robot
from pisigma.robot.se3 import rotation_from_rpy, rpy_from_rotation

STEPS = 60
"""Damped steps."""
SHORTEST = 1e-6
"""[m] Shorter steps are the last ones."""
WEAK = 0.01
"""Directions of the tool that distances determine less than this stay near the drawn ones."""
HELD = 1e4
"""The same where the tool is known."""
OUTLYING = 3.0
"""Median errors beyond which a distance counts less, so that single mistakes do not pull the tool."""
FAR_START = 0.3
"""[reach] How far from the drawn tool, each way along its axes, others begin where that leads nowhere."""
LARGEST_SHIFT, LARGEST_CLEAR_SHIFT = 0.35, 1.0
"""[reach] No tool is farther from the drawn one; distances that ask for it are mistakes, unless it meets so many that
they leave no doubt."""
MANY_TIMES = 3
"""As many distances as unknowns leave a doubt; so many times as many do not."""
DOUBTFUL = 0.01
"""Share of the tool's motion that a typical distance is off before other units are tried."""
COLLAPSED = 0.25
"""Share of the errors that is left, at most, where a unit explains them."""
MANY = 0.25
"""Share of the distances that may be off by more than `LARGEST_MISS`."""


@dataclass(frozen=True, eq=False)
class _Distances:
    """Distances of one target's rows to anchors, and to the next rows (anchor -1).

    The tool's point is `R · tool + p`, less `R_end · tool + p_end` in pairs, less an anchor otherwise.
    """

    R: Float64[Tensor, "rows 3 3"]
    p: Float64[Tensor, "rows 3"]
    anchor: Int64[Tensor, " rows"]
    measured: Float64[Tensor, " rows"]

    @property
    def unknowns(self) -> int:
        """How many there are: the tool, and every anchor with its zero."""
        return 3 + 4 * (int(self.anchor.max()) + 1)

    def start(self, tool: Float64[Tensor, " 3"]) -> Float64[Tensor, " unknowns"]:
        """Return a tool and the anchors that suit it."""
        points = (self.R @ tool) + self.p
        anchors = [
            anchor_from_distances(points[self.anchor == k], self.measured[self.anchor == k])
            for k in range((self.unknowns - 3) // 4)
        ]
        return torch.cat([tool, *anchors])

    def linearised(
        self, unknown: Float64[Tensor, " unknowns"]
    ) -> tuple[Float64[Tensor, " rows"], Float64[Tensor, "rows unknowns"]]:
        """Return measured minus predicted distances [m] and the derivative of the predicted ones."""
        wires = (self.anchor >= 0).nonzero()[:, 0]
        away, zero = (self.R @ unknown[:3]) + self.p, torch.zeros_like(self.measured)
        anchors = unknown[3:].view(-1, 4)[self.anchor[wires]]
        away[wires] -= anchors[:, :3]
        zero[wires] = anchors[:, 3]
        length = away.norm(dim=-1).clamp(min=1e-9)
        direction = away / length[:, None]
        J = torch.zeros(len(length), len(unknown), dtype=torch.float64)
        J[:, :3] = (direction[:, None] @ self.R)[:, 0]
        columns = 3 + 4 * self.anchor[wires, None] + torch.arange(4)
        J[wires[:, None], columns] = torch.cat([-direction[wires], torch.ones(len(wires), 1).double()], -1)
        return self.measured - length - zero, J

    def fitted(
        self, drawn: Float64[Tensor, " 3"], held: bool, reach: float
    ) -> tuple[Float64[Tensor, " 3"], Float64[Tensor, " rows"]]:
        """Return the tool that suits the distances best, near the drawn one or else far off, and what is left [m]."""
        best = self._polished(drawn, drawn, held)
        ways = torch.cat([torch.eye(3), -torch.eye(3)]).double() * FAR_START * reach
        for way in () if held else ways:
            if not self.is_doubtful(*best):
                break
            other = self._polished(drawn + way, drawn, held)
            best = min(best, other, key=lambda fit: float(fit[1].abs().median()))
        return best

    def is_doubtful(self, tool: Float64[Tensor, " 3"], residual: Float64[Tensor, " rows"]) -> bool:
        """Say whether a typical distance is off by much of the tool's motion."""
        points = self.R @ tool + self.p
        motion = (points - points.mean(0)).norm(dim=-1).median()
        return float(residual.abs().median()) > DOUBTFUL * float(motion)

    def _polished(
        self, start: Float64[Tensor, " 3"], drawn: Float64[Tensor, " 3"], held: bool
    ) -> tuple[Float64[Tensor, " 3"], Float64[Tensor, " rows"]]:
        """Return the tool after damped steps in which outlying distances count less, and what is left [m]."""
        unknown = self.start(start)
        pull = torch.zeros_like(unknown)
        pull[:3] = (HELD if held else WEAK) ** 2 * len(self.measured)
        damping = 1e-3
        for _ in range(STEPS):
            residual, J = self.linearised(unknown)
            limit = OUTLYING * residual.abs().median().clamp(min=1e-9)
            weight = (limit / residual.abs()).clamp(max=1.0)
            off = torch.cat([unknown[:3] - drawn, torch.zeros_like(unknown[3:])])
            normal = (J.mT * weight) @ J + torch.diag(pull)
            gradient = (J.mT * weight) @ residual - pull * off
            scale = normal.diagonal().clamp(min=1e-12)
            step = torch.linalg.solve(normal + damping * torch.diag(scale), gradient)
            if _cost(self.linearised(unknown + step)[0], limit) < _cost(residual, limit):
                unknown, damping = unknown + step, max(damping / 10, 1e-9)
            else:
                damping *= 10
            if float(step.abs().max()) < SHORTEST:
                break
        return unknown[:3], self.linearised(unknown)[0]


def tools_from_distances(
    space: ParameterSpace,
    measurements: Measurements,
    T_flange: Float64[Tensor, "rows 4 4"],
    tools: Mapping[str, np.ndarray],
    free_tool: bool,
) -> dict[str, np.ndarray]:
    """Return all tools, those that have no guess yet by the wires and pairs that suit them best, anchors with them.

    Distances between points of one arm do not depend on the base. Single wrong distances count little.

    Args:
        space: names and robot.
        measurements: the rows; those of pairs come first, side by side.
        T_flange: where the robot as drawn has the flange, in its own base.
        tools: guesses by other sensors.
        free_tool: whether tools are to be identified.

    Raises:
        ImplausibleError: distances do not suit any tool, as where they are in another unit.
    """
    tools, drawn, reach = dict(tools), space.robot.tool, space.robot.reach
    for name in space.targets:
        distances = _distances_of(measurements, T_flange, name)
        if len(distances.measured) < FEWEST:
            continue
        held = name in tools or not free_tool
        position = torch.from_numpy(tools.get(name, drawn)[:3].copy())
        tool, residual = distances.fitted(position, held, reach)
        _refuse_other_units(space.robot, distances, (tool, residual), (position, held), measurements.source)
        off = int((residual.abs() > LARGEST_MISS * reach).sum())
        if off > MANY * len(residual):
            raise ImplausibleError(
                f"{measurements.source}: expected distances that robot '{space.robot.name}' has at these joint values, "
                f"got {off} of {len(residual)} that are off by more than {LARGEST_MISS * reach * 1e3:.3g} mm whatever "
                "the tool is; check whether distances and joint values are of the same rows, and whether this robot "
                "was measured."
            )
        clear = len(residual) >= MANY_TIMES * distances.unknowns and not distances.is_doubtful(tool, residual)
        largest = (LARGEST_CLEAR_SHIFT if clear else LARGEST_SHIFT) * reach
        if not held and float((tool - position).norm()) <= largest:
            tools[name] = np.concatenate([tool.numpy(), drawn[3:]])
    return tools


def base_from_anchors(
    measurements: Measurements,
    frame: str,
    tip: Float64[Tensor, "rows 3"],
    drawn: Float64[np.ndarray, " 6"],
) -> Float64[np.ndarray, " 6"]:
    """Return T_frame_robot by the anchors that are stated in a frame, from where wires see them.

    Args:
        measurements: the rows.
        frame: name of the frame.
        tip: where the robot as drawn has its tip, in its own base [m].
        drawn: the robot's base, x, y, z [m], roll, pitch, yaw [rad]; it counts where the anchors leave the base open.
    """
    seen, stated = [], []
    for name in names_of(measurements.anchor):
        rows = [
            row
            for row, anchor in enumerate(measurements.anchor or ())
            if anchor == name and measurements.frame[row] == frame
        ]
        place = stated_position(measurements, rows[0]) if rows else None
        if place is not None and len(rows) >= FEWEST and measurements.distance is not None:
            seen.append(anchor_from_distances(tip[rows], measurements.distance.cpu()[rows])[:3])
            stated.append(place.cpu())
    if not seen:
        return drawn
    R, p = base_by_points(
        torch.stack(seen), torch.stack(stated), rotation_from_rpy(tip.new_tensor(drawn[3:]))
    )
    return torch.cat([p, rpy_from_rotation(R)]).numpy()


def _refuse_other_units(
    robot: Robot,
    distances: _Distances,
    fit: tuple[Float64[Tensor, " 3"], Float64[Tensor, " rows"]],
    start: tuple[Float64[Tensor, " 3"], bool],
    source: str,
) -> None:
    """Refuse distances that are far nearer to the robot's in another unit, errors being compared in the measured one.

    Raises:
        ImplausibleError: see above.
    """
    if not distances.is_doubtful(*fit):
        return
    typical = float(fit[1].abs().median())
    misses = [
        float(
            replace(distances, measured=distances.measured * factor)
            .fitted(*start, robot.reach)[1]
            .abs()
            .median()
        )
        for factor, _, _ in MISNAMED_UNITS
    ]
    miss, (factor, are, named) = min(
        zip(misses, MISNAMED_UNITS, strict=True), key=lambda one: one[0] / one[1][0]
    )
    if miss < LARGEST_MISS * robot.reach and miss / factor < COLLAPSED * typical:
        raise ImplausibleError(
            f"{source}: expected distances that robot '{robot.name}' has at these joint values, got {are} taken for "
            f"{named}: a typical distance is off by {typical * 1e3:.3g} mm, and multiplied by {factor:.4g} by "
            f"{miss * 1e3:.3g} mm; correct the unit in the column names."
        )


def _distances_of(measurements: Measurements, T: Tensor, target: str) -> _Distances:
    """Wires with enough distances, and pairs of which both rows have the target."""
    R, p = T[:, :3, :3], T[:, :3, 3]
    if measurements.distance is None:
        return _Distances(R[:0], p[:0], torch.zeros(0, dtype=torch.int64), p[:0, 0])
    distance = measurements.distance.cpu()
    own = torch.tensor([name == target for name in measurements.target]) & torch.isfinite(distance)
    number = numbers_of(measurements.anchor, names_of(measurements.anchor), measurements.rows)
    known, counts = torch.unique(number[own & (number >= 0)], return_counts=True)
    wires = own & torch.isin(number, known[counts >= FEWEST])
    anchor = torch.unique(number[wires], return_inverse=True)[1]
    first = torch.arange(0, 2 * len(names_of(measurements.pair)), 2)
    first = first[own[first] & own[first + 1]]
    return _Distances(
        torch.cat([R[wires], R[first] - R[first + 1]]),
        torch.cat([p[wires], p[first] - p[first + 1]]),
        torch.cat([anchor, torch.full_like(first, -1)]),
        torch.cat([distance[wires], distance[first]]),
    )


def _cost(residual: Tensor, limit: Tensor) -> float:
    """Huber's: squares up to a limit, then lines."""
    size = residual.abs()
    return float(torch.where(size <= limit, size.square(), 2 * limit * size - limit.square()).sum())
