"""Effects of parameters on the tool, whitened by the uncertainties of two models."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.lifetime.comparison.model_pair import ModelPair, frames_of
from pisigma.lifetime.recalibration.movement import Movement, sigma_along
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.sensor import SHOWN_UNITS
from pisigma.model.calibrated_model import CalibratedModel, corrected_joints
from pisigma.robot.frame_fits import LEVER_SHARE
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian
from pisigma.robot.se3 import rotation_from_vector, rotation_vector, skew, xyz_zyx_from_transform

_MODEL_ERROR = 2e-5
"""Standard deviation of predicted coordinates [m] in addition to that of the posteriors, about a robot's
repeatability."""
_MIN_DISTINCT_SHARE = 0.01
"""Share of a parameter's effect that is distinct from other effects, below which the parameter is unobservable."""
_ALIKE = 1 - _MIN_DISTINCT_SHARE**2
"""Correlation of effects above which parameters are exchangeable."""
_ROUND_OFF = 1e-9
"""Share of the variance below which it is round-off."""
_FRAME_UNITS = ("m", "m", "m", "rad", "rad", "rad")
_FRAME_MOTIONS = ("along x", "along y", "along z", "about x", "about y", "about z")

Frames = tuple[Float64[Tensor, "4 4"], Float64[Tensor, "4 4"]]
"""Type of a base and a tool."""


@dataclass(frozen=True)
class Difference:
    """Difference of a parameter between two models.

    Attributes:
        shift: difference with its name, such as "joint 3" or "a_2"; a joint zero counts in the joint's direction.
        equivalent_parameters: names of parameters with the same effect on the tool, which may differ instead.
    """

    shift: Movement
    equivalent_parameters: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """Clause, such as "joint 3 by 0.25 ± 0.01 deg"."""
        alike = (
            f" (or, equivalently, {' or '.join(self.equivalent_parameters)})"
            if self.equivalent_parameters
            else ""
        )
        return f"{self.shift.what}{alike} by {self.shift.shift_text}"

    def to_json(self) -> dict[str, object]:
        """Return plain values; see `Movement.to_json`."""
        return {**self.shift.to_json(), "equivalent": list(self.equivalent_parameters)}


class ParameterEffects:
    """Displacement of the tool between two models, and the effects of parameters on it, both whitened.

    With the displacement d at the points of a pair and its derivatives J with respect to the parameters, values are
    `L^-1 d` and columns `L^-1 J`, where `L L^T` is the covariance of d under both posteriors. The parameters are those
    of the arm (theta, d, a, alpha, beta of every row), then translation and rotation of the base, about its origin and
    along the axes of the measuring frame, and those of the tool, along its own axes.

    Attributes:
        tested: indices of the tested parameters: only one of several exchangeable parameters, and no parameter that
            moves the tool as a free base or tool does.
    """

    def __init__(self, pair: ModelPair) -> None:
        """Linearise at the first model."""
        q = pair.training_joints
        d = pair.displacement(q)
        there = torch.isfinite(d).all(1)
        q, d = q[there], d[there]
        lever = LEVER_SHARE * pair.first.robot.reach
        weight = torch.tensor([1.0, 1.0, 1.0, lever, lever, lever], dtype=torch.float64)[:, None]
        frames = frames_of(pair.first, pair.frame_names[0]), pair.frames_of_second()
        base, tool = _geometry(frames[0])
        robot = pair.first.identified.with_geometry(base=base, tool=tool)
        T, J = identification_jacobian(robot, _corrected(pair.first, q))
        spread = [
            _spread(model, frame_names, those, q)
            for model, frame_names, those in zip(
                (pair.first, pair.second), pair.frame_names, frames, strict=True
            )
        ]
        self._pair, self._arm = pair, J.shape[-1] - 12
        columns = torch.cat([J[..., :-12], _frame_columns(T, frames[0][0][:3, 3])], -1)
        X, G, y = ((weight * one).flatten(0, 1) for one in (columns, torch.cat(spread, -1), d[..., None]))
        covariance = G @ G.t()
        S = covariance.clone()
        S.diagonal().add_(_MODEL_ERROR**2)
        L = torch.linalg.cholesky(S)
        self._y, self._W, half = (
            torch.linalg.solve_triangular(L, one, upper=False) for one in (y, X, covariance)
        )
        self._M = torch.linalg.solve_triangular(L, half.t(), upper=False)
        fitted = pair.frames == "fitted"
        self._free = list(range(self._arm, self._arm + 12)) if fitted else []
        left, self._observable = self._left([])
        unit = left / left.norm(dim=0).clamp(min=1e-300)
        self._alike = ((unit.t() @ unit).abs() > _ALIKE) & self._observable & self._observable[:, None]
        rank = torch.tensor([not self._is_zero(number) for number in range(len(self._alike))]) * len(
            self._alike
        )
        rank = rank + torch.arange(len(rank))
        first = torch.where(self._alike, rank, 2 * len(rank)).amin(1) == rank
        self.tested = (first & self._observable).nonzero()[:, 0].tolist()

    def parameters_with_same_effect(self, parameter_index: int) -> tuple[int, ...]:
        """Return the other parameters with the same effect as a parameter."""
        return tuple(
            other
            for other in self._alike[parameter_index].nonzero()[:, 0].tolist()
            if other != parameter_index
        )

    def shift(self, parameter_index: int, explained_parameters: Sequence[int]) -> tuple[float, float] | None:
        """Estimate the shift of a parameter given others, and its standard deviation [m or rad].

        Returns:
            The shift and its standard deviation; None if the parameter moves the tool in the same way as the given
            parameters.
        """
        left, observable = self._left(explained_parameters)
        if not bool(observable[parameter_index]):
            return None
        size = float(left[:, parameter_index].norm())
        return float(left[:, parameter_index] @ self._y[:, 0]) / size**2, 1 / size

    def standard_scores(self, explained_parameters: Sequence[int]) -> Float64[Tensor, " parameters"]:
        """Compute the ratio of shift to standard deviation of every tested parameter given others; 0 if not tested."""
        left, observable = self._left(explained_parameters)
        tested = torch.zeros_like(observable)
        tested[self.tested] = True
        scores: Tensor = (left.t() @ self._y)[:, 0] / left.norm(dim=0).clamp(min=1e-300)
        scores[~(tested & observable)] = 0.0
        return scores

    def remainder_p_value(self, explained_parameters: Sequence[int]) -> float:
        """Compute the probability that the displacement not explained by the given parameters is due to chance.

        The sum of squares is compared with that of normal values with the covariance of the posteriors, by
        Satterthwaite's approximation (1946, Biometrics Bulletin 2(6), 110-114).
        """
        square = float(self._without(self._y, explained_parameters).square().sum())
        M = self._without(self._without(self._M, explained_parameters).t(), explained_parameters)
        mean, half_variance = float(M.trace()), float(M.square().sum())
        if mean <= _ROUND_OFF * float(self._M.trace()):  # the given parameters explain all that is uncertain
            return float(square <= len(self._y))
        of_both = torch.tensor([mean**2, square * mean], dtype=torch.float64) / half_variance / 2
        return float(torch.special.gammaincc(of_both[0], of_both[1]))

    def estimate_shifts(self, chosen: Sequence[int]) -> tuple[tuple[Difference, ...], tuple[Movement, ...]]:
        """Estimate the shifts of chosen parameters together with base and tool.

        Returns:
            The shifts of the parameters (of joint zeros in the direction of the joint), and the distances and angles by
            which base and tool of the second model differ (empty if the frames are fixed).
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
        """Return a shift of a parameter with its name and unit."""
        unit, factor = SHOWN_UNITS[self._unit(number)]
        name = self._name(number)
        if self._is_zero(number):
            row = self._pair.first.identified.rows[number // 5]
            name, factor = f"joint {name.partition('_')[2]}", factor * row.direction
        alike = tuple(map(self._name, self.parameters_with_same_effect(number)))
        return Difference(Movement(name, shift * factor, deviation * abs(factor), unit), alike)

    def _name(self, number: int) -> str:
        if number < self._arm:
            return ParameterSpace(self._pair.first.identified).names[number]
        what, motion = divmod(number - self._arm, 6)
        return f"{('base', 'tool')[what]} {_FRAME_MOTIONS[motion]}"

    def _is_zero(self, number: int) -> bool:
        """Return whether a parameter is a joint zero: theta, or d of a prismatic joint."""
        row, column = divmod(number, 5)
        if number >= self._arm or column > 1:
            return False
        return self._pair.first.identified.rows[row].type == ("revolute", "prismatic")[column]

    def _unit(self, number: int) -> str:
        if number >= self._arm:
            return _FRAME_UNITS[(number - self._arm) % 6]
        return ParameterSpace(self._pair.first.identified).parameters[number].unit

    def _frames(
        self, shift: Float64[Tensor, "12"], covariance: Float64[Tensor, "12 12"]
    ) -> tuple[Movement, ...]:
        """Return the differences of base and tool of both models: the fitted motion plus the linear estimate."""
        pair, (base, _) = self._pair, frames_of(self._pair.first, self._pair.frame_names[0])
        X, Y, origin = pair.T_first_second, pair.T_second_tool_first_tool, base[:3, 3]
        moved = []
        # X base_2 = exp(step) base_1 and tool_2 Y = tool_1 exp(step)
        for what, step, C, R, was, now in (
            ("base", shift[:6], covariance[:6, :6], X[:3, :3], X[:3, :3] @ origin + X[:3, 3], origin),
            ("tool", shift[6:], covariance[6:, 6:], Y[:3, :3], Y[:3, :3].t() @ Y[:3, 3], 0.0 * origin),
        ):
            length = now + step[:3] - was
            angle = rotation_vector(rotation_from_vector(step[3:]) @ R.t())
            moved += [
                Movement(what, float(vector.norm()) * factor, sigma_along(vector, block) * factor, unit)
                for vector, block, (unit, factor) in (
                    (length, C[:3, :3], SHOWN_UNITS["m"]),
                    (angle, C[3:, 3:], SHOWN_UNITS["rad"]),
                )
            ]
        return tuple(moved)

    def _left(
        self, given: Sequence[int]
    ) -> tuple[Float64[Tensor, "values parameters"], Bool[Tensor, " parameters"]]:
        """Return the columns with given parameters and free frames projected out, and the mask of observable ones."""
        left = self._without(self._W, given)
        return left, left.norm(dim=0) > _MIN_DISTINCT_SHARE * self._W.norm(dim=0)

    def _without(
        self, columns: Float64[Tensor, "values columns"], given: Sequence[int]
    ) -> Float64[Tensor, "values columns"]:
        """Project out the columns of given parameters, and of base and tool where these are free."""
        others = [*self._free, *given]
        if not others:
            return columns
        Q = torch.linalg.qr(self._W[:, others])[0]
        left: Tensor = columns - Q @ (Q.t() @ columns)
        return left


def _geometry(frames: Frames) -> list[Float64[np.ndarray, " 6"]]:
    return [xyz_zyx_from_transform(frame).numpy() for frame in frames]


def _corrected(model: CalibratedModel, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses dof"]:
    """Return corrected joint values, which enter the geometry of a model."""
    return q if model.hybrid is None else corrected_joints(model.hybrid, Measurements(q=q))


def _spread(
    model: CalibratedModel, frame_names: tuple[str, str], frames: Frames, q: Float64[Tensor, "poses dof"]
) -> Float64[Tensor, "poses 6 directions"]:
    """Return the root of the covariance of predicted poses, for a tool and frame that may have been moved."""
    known = model.uncertainty
    if known is None:
        return torch.zeros((len(q), 6, 0), dtype=torch.float64)
    space, there = known.space, known.geometry
    number = [
        names.index(name) for names, name in zip((space.frames, space.targets), frame_names, strict=True)
    ]
    base, tool = _geometry(frames)
    geometry = replace(
        there,
        bases={**there.bases, list(there.bases)[number[0]]: base},
        tools={**there.tools, list(there.tools)[number[1]]: tool},
    )
    columns = replace(known, geometry=geometry).pose_derivatives(JointState(q), _corrected(model, q), *number)
    return known.covariance_root.left_multiply(columns)


def _frame_columns(
    T: Float64[Tensor, "poses 4 4"], base: Float64[Tensor, "3"]
) -> Float64[Tensor, "poses 6 12"]:
    """Compute derivatives of tool poses with respect to the poses of base (about its origin) and tool."""
    R, none = T[:, :3, :3], torch.zeros_like(T[:, :3, :3])
    eye = torch.eye(3, dtype=T.dtype).expand_as(R)
    shift = torch.cat([eye, -skew(T[:, :3, 3] - base), R, none], -1)
    return torch.cat([shift, torch.cat([none, eye, none, R], -1)], -2)
