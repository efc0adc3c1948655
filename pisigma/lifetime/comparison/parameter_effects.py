"""Effects of parameters on the tool, in the metric of what two models do not know."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.lifetime.comparison.model_pair import ModelPair, frames_of
from pisigma.lifetime.recalibration.movement import Movement, deviation_along
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.sensor import SHOWN_UNITS
from pisigma.model.calibrated_model import CalibratedModel, corrected_joints
from pisigma.robot.frame_fits import LEVER_SHARE
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian
from pisigma.robot.se3 import rotation_from_vector, rotation_vector, skew, xyzrpy_from_transform

FLOOR = 2e-5
"""[m] Standard deviation of predicted coordinates that no posterior knows of, as a robot's repeatability."""
SAME_MOTION = 0.01
"""Share of a parameter's effect below which what is left of it beside others does not count: nearly parallel axes."""
ALIKE = 1 - SAME_MOTION**2
"""Parameters whose effects are correlated by more than this are exchangeable."""
FRAME_UNITS = ("m", "m", "m", "rad", "rad", "rad")
FRAME_MOTIONS = ("along x", "along y", "along z", "about x", "about y", "about z")

Frames = tuple[Float64[Tensor, "4 4"], Float64[Tensor, "4 4"]]
"""A base and a tool."""


@dataclass(frozen=True)
class Difference:
    """By how much one parameter differs.

    Attributes:
        shift: with its name, such as "joint 3" or "a_2"; that of a joint's zero counts in the joint's direction.
        alike: names of parameters that have the same effect on the tool, so that it may be these instead.
    """

    shift: Movement
    alike: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """It in words, with half the 95 % interval."""
        alike = f" (or {' or '.join(self.alike)}, to the same effect)" if self.alike else ""
        return f"{self.shift.what}{alike} by {self.shift.size}"

    def to_json(self) -> dict[str, object]:
        """Return it as plain values, the unit in the name of the shift."""
        return {**self.shift.to_json(), "alike": list(self.alike)}


class ParameterEffects:
    """By how much the second model has the tool elsewhere, and effects of parameters on it, both whitened.

    With d the displacement at the points of a pair and J its derivatives by the parameters, values are `L^-1 d` and
    columns `L^-1 J`, where `L L^T` is the covariance of d under both posteriors. The parameters are those of the arm
    (theta, d, a, alpha, beta of every row), then shift and turn of the base, about its origin and along the axes of the
    measuring frame, and those of the tool, along its own axes.

    Attributes:
        tested: indices of the parameters that are tested: one of several that are exchangeable, and none that moves the
            tool as base and tool do, where these are free.
    """

    def __init__(self, pair: ModelPair) -> None:
        """Linearise at the first model."""
        q = pair.points
        d = pair.displacement(q)
        there = torch.isfinite(d).all(1)
        q, d = q[there], d[there]
        lever = LEVER_SHARE * pair.first.robot.reach
        weight = torch.tensor([1.0, 1.0, 1.0, lever, lever, lever], dtype=torch.float64)[:, None]
        frames = frames_of(pair.first, pair.owner[0]), pair.frames_of_second()
        base, tool = _geometry(frames[0])
        robot = pair.first.identified.with_geometry(base=base, tool=tool)
        T, J = identification_jacobian(robot, _corrected(pair.first, q))
        spread = [
            _spread(model, owner, those, q)
            for model, owner, those in zip((pair.first, pair.second), pair.owner, frames, strict=True)
        ]
        self._pair, self._arm = pair, J.shape[-1] - 12
        columns = torch.cat([J[..., :-12], _frame_columns(T, frames[0][0][:3, 3])], -1)
        X, G, y = ((weight * one).flatten(0, 1) for one in (columns, torch.cat(spread, -1), d[..., None]))
        covariance = G @ G.t()
        S = covariance.clone()
        S.diagonal().add_(FLOOR**2)
        L = torch.linalg.cholesky(S)
        self._y, self._W, half = (
            torch.linalg.solve_triangular(L, one, upper=False) for one in (y, X, covariance)
        )
        self._M = torch.linalg.solve_triangular(L, half.t(), upper=False)
        fitted = pair.frames == "fitted"
        self._free = list(range(self._arm, self._arm + 12)) if fitted else []
        left, self._observable = self._left([])
        unit = left / left.norm(dim=0).clamp(min=1e-300)
        self._alike = ((unit.t() @ unit).abs() > ALIKE) & self._observable & self._observable[:, None]
        rank = torch.tensor([not self._is_zero(number) for number in range(len(self._alike))]) * len(
            self._alike
        )
        rank = rank + torch.arange(len(rank))
        first = torch.where(self._alike, rank, 2 * len(rank)).amin(1) == rank
        self.tested = (first & self._observable).nonzero()[:, 0].tolist()

    def alike(self, number: int) -> tuple[int, ...]:
        """Other parameters that have the very same effect as one."""
        return tuple(other for other in self._alike[number].nonzero()[:, 0].tolist() if other != number)

    def shift(self, number: int, beside: Sequence[int]) -> tuple[float, float] | None:
        """Estimate the shift [m or rad] of one parameter beside others, and its standard deviation.

        Returns:
            None where it moves the tool as those do.
        """
        left, observable = self._left(beside)
        if not bool(observable[number]):
            return None
        size = float(left[:, number].norm())
        return float(left[:, number] @ self._y[:, 0]) / size**2, 1 / size

    def scores(self, beside: Sequence[int]) -> Float64[Tensor, " parameters"]:
        """Shift over its standard deviation of every tested parameter beside others; 0 of those not tested."""
        left, observable = self._left(beside)
        tested = torch.zeros_like(observable)
        tested[self.tested] = True
        scores: Tensor = (left.t() @ self._y)[:, 0] / left.norm(dim=0).clamp(min=1e-300)
        scores[~(tested & observable)] = 0.0
        return scores

    def remainder(self, beside: Sequence[int]) -> float:
        """Probability of what is left of the displacement beside parameters, or of more, by chance.

        The sum of squares is compared with that of normal values of the covariance that the posteriors have, by
        Satterthwaite's approximation (1946, Biometrics Bulletin 2(6), 110-114).
        """
        square = float(self._without(self._y, beside).square().sum())
        M = self._without(self._without(self._M, beside).t(), beside)
        mean, half_variance = float(M.trace()), float(M.square().sum())
        if half_variance == 0.0:
            return float(square <= len(self._y))
        of_both = torch.tensor([mean**2, square * mean], dtype=torch.float64) / half_variance / 2
        return float(torch.special.gammaincc(of_both[0], of_both[1]))

    def differing(self, chosen: Sequence[int]) -> tuple[tuple[Difference, ...], tuple[Movement, ...]]:
        """Estimate shifts of chosen parameters together with base and tool.

        Returns:
            The shifts of the parameters, those of joints' zeros in the direction of the joint; and how far the second
            model has base and tool elsewhere, in length and angle, nothing where frames are fixed.
        """
        inverse = torch.linalg.pinv(self._W[:, [*chosen, *self._free]])
        shift, covariance = (inverse @ self._y)[:, 0], inverse @ inverse.t()
        differing = tuple(
            self._difference(number, float(by), float(variance) ** 0.5)
            for number, by, variance in zip(chosen, shift, covariance.diagonal(), strict=False)
        )
        first = len(chosen)
        return differing, self._frames(shift[first:], covariance[first:, first:]) if self._free else ()

    def _difference(self, number: int, shift: float, deviation: float) -> Difference:
        """A shift of a parameter with its name and unit."""
        unit, factor = SHOWN_UNITS[self._unit(number)]
        name = self._name(number)
        if self._is_zero(number):
            row = self._pair.first.identified.rows[number // 5]
            name, factor = f"joint {name.partition('_')[2]}", factor * row.direction
        alike = tuple(map(self._name, self.alike(number)))
        return Difference(Movement(name, shift * factor, deviation * abs(factor), unit), alike)

    def _name(self, number: int) -> str:
        if number < self._arm:
            return ParameterSpace(self._pair.first.identified).names[number]
        what, motion = divmod(number - self._arm, 6)
        return f"{('base', 'tool')[what]} {FRAME_MOTIONS[motion]}"

    def _is_zero(self, number: int) -> bool:
        """Whether a parameter is the zero of a joint: theta, or d of a joint that slides."""
        row, column = divmod(number, 5)
        if number >= self._arm or column > 1:
            return False
        return self._pair.first.identified.rows[row].type == ("revolute", "prismatic")[column]

    def _unit(self, number: int) -> str:
        if number >= self._arm:
            return FRAME_UNITS[(number - self._arm) % 6]
        return ParameterSpace(self._pair.first.identified).parameters[number].unit

    def _frames(
        self, shift: Float64[Tensor, "12"], covariance: Float64[Tensor, "12 12"]
    ) -> tuple[Movement, ...]:
        """How far the second model has base and tool elsewhere: the motion that was fitted, and the linear rest."""
        pair, (base, _) = self._pair, frames_of(self._pair.first, self._pair.owner[0])
        X, Y, origin = pair.T_base, pair.T_tool, base[:3, 3]
        moved = []
        # X base_2 = exp(step) base_1 and tool_2 Y = tool_1 exp(step)
        for what, step, C, R, was, now in (
            ("base", shift[:6], covariance[:6, :6], X[:3, :3], X[:3, :3] @ origin + X[:3, 3], origin),
            ("tool", shift[6:], covariance[6:, 6:], Y[:3, :3], Y[:3, :3].t() @ Y[:3, 3], 0.0 * origin),
        ):
            length = now + step[:3] - was
            angle = rotation_vector(rotation_from_vector(step[3:]) @ R.t())
            moved += [
                Movement(what, float(vector.norm()) * factor, deviation_along(vector, block) * factor, unit)
                for vector, block, (unit, factor) in (
                    (length, C[:3, :3], SHOWN_UNITS["m"]),
                    (angle, C[3:, 3:], SHOWN_UNITS["rad"]),
                )
            ]
        return tuple(moved)

    def _left(
        self, beside: Sequence[int]
    ) -> tuple[Float64[Tensor, "values parameters"], Bool[Tensor, " parameters"]]:
        """What is left of all columns beside others and free frames, and of which enough is to be tested."""
        left = self._without(self._W, beside)
        return left, left.norm(dim=0) > SAME_MOTION * self._W.norm(dim=0)

    def _without(
        self, columns: Float64[Tensor, "values columns"], beside: Sequence[int]
    ) -> Float64[Tensor, "values columns"]:
        """What is left of columns beside those of parameters, and of base and tool where these are free."""
        others = [*self._free, *beside]
        if not others:
            return columns
        Q = torch.linalg.qr(self._W[:, others])[0]
        left: Tensor = columns - Q @ (Q.t() @ columns)
        return left


def _geometry(frames: Frames) -> list[Float64[np.ndarray, " 6"]]:
    return [xyzrpy_from_transform(frame).numpy() for frame in frames]


def _corrected(model: CalibratedModel, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses dof"]:
    """Joint values that go through the geometry of a model."""
    return q if model.hybrid is None else corrected_joints(model.hybrid, Measurements(q=q))


def _spread(
    model: CalibratedModel, owner: tuple[str, str], frames: Frames, q: Float64[Tensor, "poses dof"]
) -> Float64[Tensor, "poses 6 directions"]:
    """Root of the covariance of predicted poses, of a tool and in a frame that may have been moved."""
    known = model.uncertainty
    if known is None:
        return torch.zeros((len(q), 6, 0), dtype=torch.float64)
    space, there = known.space, known.geometry
    number = [names.index(name) for names, name in zip((space.frames, space.targets), owner, strict=True)]
    base, tool = _geometry(frames)
    geometry = replace(
        there,
        bases={**there.bases, list(there.bases)[number[0]]: base},
        tools={**there.tools, list(there.tools)[number[1]]: tool},
    )
    columns = replace(known, geometry=geometry).columns(JointState(q), _corrected(model, q), *number)
    return known.covariance_root.along(columns)


def _frame_columns(
    T: Float64[Tensor, "poses 4 4"], base: Float64[Tensor, "3"]
) -> Float64[Tensor, "poses 6 12"]:
    """Derivatives of tool poses by shift and turn of the base, about its origin, and of the tool, along its axes."""
    R, none = T[:, :3, :3], torch.zeros_like(T[:, :3, :3])
    eye = torch.eye(3, dtype=T.dtype).expand_as(R)
    shift = torch.cat([eye, -skew(T[:, :3, 3] - base), R, none], -1)
    return torch.cat([shift, torch.cat([none, eye, none, R], -1)], -2)
