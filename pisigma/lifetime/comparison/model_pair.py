"""Pairs of models of one robot, with their bases and tools aligned, and displacements of their poses."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.files.errors import ModelError
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.robot.description import Robot
from pisigma.robot.frame_fits import LEVER_SHARE, MeasuredPoses, best_base_and_tool
from pisigma.robot.se3 import invert, pose_error, transform_from_xyz_zyx
from pisigma.validation.held_out.pose_statistics import PoseErrors

FrameChoice = Literal["fitted", "fixed"]
"""Whether base and tool of the second model are fitted to those of the first model, or identified by name."""

_POINTS = 60
"""Number of configurations, half from each model, at which models are compared with their uncertainties."""
_SAMPLES = 3_000
"""Number of samples of the workspace."""
_FITTED_SAMPLES = 300
"""Number of samples to which base and tool are fitted."""
_MAX_NOMINAL_DIFFERENCE = 0.02
"""Difference of nominal parameters [rad, or share of the reach] up to which models belong to one robot."""


@dataclass(frozen=True, eq=False)
class ModelPair:
    """Two models of one robot.

    Attributes:
        first: reference model.
        second: model that is compared with it.
        frames: how bases and tools are aligned.
        frame_names: names of the frame and the target in which each model is compared.
        T_first_second: transform from the frame of the second model to that of the first; the identity for fixed
            frames.
        T_second_tool_first_tool: pose of the first model's tool in the tool frame of the second; the identity for
            fixed frames.
    """

    first: CalibratedModel
    second: CalibratedModel
    frames: FrameChoice
    frame_names: tuple[tuple[str, str], tuple[str, str]]
    T_first_second: Float64[Tensor, "4 4"]
    T_second_tool_first_tool: Float64[Tensor, "4 4"]

    @staticmethod
    def from_models(first: CalibratedModel, second: CalibratedModel, frames: FrameChoice) -> "ModelPair":
        """Pair two models.

        Args:
            first: reference model.
            second: model that is compared with it.
            frames: "fitted" moves base and tool of the second model so that the arms agree best.

        Raises:
            ModelError: the models belong to different robots, have no frame or target in common although these are
                fixed, or store no joint values at which both predict a pose.
        """
        _check_one_robot(first, second)
        frame_names = _frame_names(first, second, frames)
        eye = torch.eye(4, dtype=torch.float64)
        pair = ModelPair(first, second, frames, frame_names, eye, eye)
        T_first, T_second = pair.poses(pair.workspace_joints[:: _SAMPLES // _FITTED_SAMPLES])
        there = torch.isfinite(T_first + T_second).all(-1).all(-1)
        if not bool(there.any()):
            raise ModelError(
                f"models {first.name} and {second.name} store no joint values at which both predict a pose",
                remedy="make them again with `pisigma calibrate` or `pisigma train`",
            )
        if frames == "fixed":
            return pair
        lever = LEVER_SHARE * first.robot.reach
        measured = MeasuredPoses(T_first[there, :3, 3], T_first[there, :3, :3], there[there], lever)
        return ModelPair(first, second, frames, frame_names, *best_base_and_tool(T_second[there], measured))

    @property
    def training_joints(self) -> Float64[Tensor, "points dof"]:
        """Joint values of training rows that the models store, half from each [rad or m]."""
        generator = torch.Generator().manual_seed(0)
        sampled = [
            model.starts[torch.randperm(len(model.starts), generator=generator)[: _POINTS // 2]]
            for model in (self.first, self.second)
        ]
        return torch.cat(sampled)

    @property
    def workspace_joints(self) -> Float64[Tensor, "samples dof"]:
        """Joint values that the models store, and random joint values within their common ranges [rad or m]."""
        kept = torch.unique(torch.cat([self.first.starts, self.second.starts]), dim=0)
        ranges = [(model.starts.amin(0), model.starts.amax(0)) for model in (self.first, self.second)]
        low, high = torch.maximum(ranges[0][0], ranges[1][0]), torch.minimum(ranges[0][1], ranges[1][1])
        inside = ((kept >= low) & (kept <= high)).all(1)
        kept = kept[inside] if bool(inside.any()) else kept
        if bool((low > high).any()):  # the models were measured in different places
            low, high = kept.amin(0), kept.amax(0)
        generator = torch.Generator().manual_seed(0)
        sampled = torch.rand(
            max(_SAMPLES - len(kept), 0), kept.shape[1], generator=generator, dtype=kept.dtype
        )
        return torch.cat([kept[:_SAMPLES], low + sampled * (high - low)])

    def poses(
        self, q: Float64[Tensor, "poses dof"]
    ) -> tuple[Float64[Tensor, "poses 4 4"], Float64[Tensor, "poses 4 4"]]:
        """Predict the tool poses of both models in the frame of the first [m]; NaN where a model predicts no pose."""
        first, second = (
            poses_of_rows(model, Measurements(q=q, frame=(frame,) * len(q), target=(target,) * len(q)))
            for model, (frame, target) in zip((self.first, self.second), self.frame_names, strict=True)
        )
        return first, self.T_first_second @ second @ self.T_second_tool_first_tool

    @torch.no_grad()
    def displacement(self, q: Float64[Tensor, "poses dof"]) -> Float64[Tensor, "poses 6"]:
        """Compute the displacement of the tool in the second model: translation [m] and rotation vector [rad]."""
        first, second = self.poses(q)
        there = torch.isfinite(first + second).all(-1).all(-1)[:, None, None]
        eye = torch.eye(4, dtype=torch.float64)
        error = pose_error(torch.where(there, second, eye), torch.where(there, first, eye))
        return torch.where(there[..., 0], error, torch.nan)

    def frames_of_second(self) -> tuple[Float64[Tensor, "4 4"], Float64[Tensor, "4 4"]]:
        """Return base and tool of the second model, aligned with those of the first."""
        base, tool = frames_of(self.second, self.frame_names[1])
        return self.T_first_second @ base, tool @ self.T_second_tool_first_tool


def frames_of(
    model: CalibratedModel, frame_names: tuple[str, str]
) -> tuple[Float64[Tensor, "4 4"], Float64[Tensor, "4 4"]]:
    """Return base and tool of the geometry with which a model predicts, for the names of a frame and a target."""
    robot = model.identified
    bases, tools = (
        (model.bases, model.tools) if model.hybrid is None else (model.hybrid_bases, model.hybrid_tools)
    )
    base, tool = bases.get(frame_names[0], robot.base), tools.get(frame_names[1], robot.tool)
    T = [transform_from_xyz_zyx(torch.from_numpy(np.array(frame))) for frame in (base, tool)]
    return T[0], T[1]


def nominal_robot(model: CalibratedModel) -> Robot:
    """Return the nominal robot of a model."""
    return model.nominal or model.robot


def _frame_names(
    first: CalibratedModel, second: CalibratedModel, frames: FrameChoice
) -> tuple[tuple[str, str], tuple[str, str]]:
    """Return the frame and target in which each model is compared: the first common names, or each model's first."""
    names_of_models: tuple[list[str], list[str]] = ([], [])
    for what, mine, others in (
        ("frame", first.bases, second.bases),
        ("target", first.tools, second.tools),
    ):
        names = list(mine) or [""], list(others) or [""]
        common = [name for name in names[0] if name in names[1]]
        if not common and frames == "fixed" and "" not in (names[0][0], names[1][0]):
            raise ModelError(
                f"models {first.name} and {second.name} have no {what} in common ({', '.join(names[0])} and "
                f"{', '.join(names[1])})",
                option=what,
                value=f"{', '.join(names[0])} and {', '.join(names[1])}",
                remedy="compare them with fitted frames",
            )
        for own, chosen in zip(names_of_models, names, strict=True):
            own.append(common[0] if common else chosen[0])
    return (names_of_models[0][0], names_of_models[0][1]), (names_of_models[1][0], names_of_models[1][1])


def _check_one_robot(first: CalibratedModel, second: CalibratedModel) -> None:
    """Refuse models of different robots."""
    robots = nominal_robot(first), nominal_robot(second)
    quantity, what = _difference(*robots)
    if quantity:
        raise ModelError(
            f"models {first.name} (robot '{robots[0].name}') and {second.name} (robot '{robots[1].name}') belong to "
            f"different robots: {what}",
            value=quantity,
            remedy="give two models of one robot",
        )


def _difference(one: Robot, other: Robot) -> tuple[str, str]:
    """Return the quantity in which two nominal robots differ, and the difference; both are "" for the same robot."""
    if one.dof != other.dof:
        return "joints", f"one has {one.dof} joints and the other {other.dof}"
    types = [[row.type for row in robot.rows] for robot in (one, other)]
    if types[0] != types[1]:
        return (
            "rows",
            f"the rows of the first are {', '.join(types[0])}, those of the second {', '.join(types[1])}",
        )
    if tuple(one.directions) != tuple(other.directions):
        return "directions", "a joint has the opposite direction"
    if not _coupled_alike(one, other):
        return "coupling", "their joint couplings differ"
    scale = np.array([1.0, one.reach, one.reach, 1.0, 1.0])
    by = one.dh - other.dh
    by[:, [0, 3, 4]] = 2 * np.sin(by[:, [0, 3, 4]] / 2)  # angles are compared modulo one revolution
    apart = np.abs(by) / scale
    row, column = np.unravel_index(int(apart.argmax()), apart.shape)
    if apart[row, column] <= _MAX_NOMINAL_DIFFERENCE:
        return "", ""
    name = ("theta", "d", "a", "alpha", "beta")[int(column)]
    unit, factor = ("mm", 1e3) if name in ("d", "a") else ("deg", float(np.rad2deg(1.0)))
    values = [f"{robot.dh[row, column] * factor:.6g}" for robot in (one, other)]
    return (
        name,
        f"the nominal {name} of row '{one.rows[row].name}' is {values[0]} {unit} in the first and {values[1]} "
        f"{unit} in the second",
    )


def _coupled_alike(one: Robot, other: Robot) -> bool:
    """Return whether equal controller values of both robots correspond to the same joint values."""
    if len(one.axes) != len(other.axes):
        return False
    values = np.eye(len(one.axes))
    return bool(np.allclose(one.to_dh(values), other.to_dh(values), equal_nan=True))


@dataclass(frozen=True, eq=False)
class Displacement:
    """Distances between the poses that two models predict for the same joint values.

    Attributes:
        source: description of the poses.
        q: joint values of poses that both models predict [rad or m].
        number: number of every pose among all poses of the source, from 1.
        position: position of the tool in the robot's base frame under the first model [m].
        errors: distance [m] and angle [rad] between the poses of both models.
        poses_not_predicted: number of poses that are left out because a model does not predict them.
    """

    source: str
    q: Float64[Tensor, "poses dof"]
    number: Int64[Tensor, " poses"]
    position: Float64[Tensor, "poses 3"]
    errors: PoseErrors
    poses_not_predicted: int

    @staticmethod
    def from_pair(pair: ModelPair, q: Float64[Tensor, "poses dof"], source: str) -> "Displacement":
        """Compare a pair of models at joint values.

        Args:
            pair: the models.
            q: joint values [rad or m].
            source: description of the joint values, such as a file.

        Raises:
            ModelError: there is no pose that both models predict.
        """
        by = pair.displacement(q)
        there = torch.isfinite(by).all(1)
        if not bool(there.any()):
            raise ModelError(
                f"{pair.first.name} and {pair.second.name} predict no pose of {source}",
                value=source,
                remedy="give poses that the robot reaches",
            )
        base = frames_of(pair.first, pair.frame_names[0])[0]
        place = (invert(base) @ pair.poses(q[there])[0])[:, :3, 3]
        errors = PoseErrors(by[there, :3].norm(dim=-1), by[there, 3:].norm(dim=-1))
        number = there.nonzero()[:, 0]
        return Displacement(source, q[there], number + 1, place, errors, len(q) - len(number))

    @property
    def index_of_largest(self) -> int:
        """Index of the pose with the largest distance."""
        return int(self.errors.position.argmax())

    def to_json(self, robot: Robot) -> dict[str, Any]:
        """Return plain values: statistics in mm and deg, and where the largest distance is.

        Args:
            robot: robot that converts joint values to controller values.
        """
        values = robot.to_controller(self.q[self.index_of_largest].numpy()).tolist()
        return {
            "source": self.source,
            "poses": len(self.q),
            "poses_not_predicted": self.poses_not_predicted,
            **self.errors.figures.figures_by_name,
            "largest_at_pose": int(self.number[self.index_of_largest]),
            "largest_at_mm": (self.position[self.index_of_largest] * 1e3).tolist(),
            "largest_at_joints": [
                axis.in_file_unit(value) for axis, value in zip(robot.axes, values, strict=True)
            ],
        }
