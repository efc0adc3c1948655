"""What a feature is: functions of the joint values that a joint's correction is a weighted sum of."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from pisigma.files.yaml_file import Section
from pisigma.joint_correction.onnx_graph import OnnxGraph
from pisigma.measurement.conditions import JointState
from pisigma.robot.description import Robot
from pisigma.robot.kernels.forms import CompiledForm

USUAL_SIZE = 2e-5
"""Prior size [rad] of weights of which nothing else is known."""
Feature = TypeVar("Feature", bound="AbstractFeature")


class FeatureSection(Section):
    """A feature in the description of a model: its name, and in subclasses what else it is made from."""

    name: str


@dataclass(frozen=True)
class FeatureOptions:
    """What a calibrator says to the features that it tries.

    Attributes:
        harmonics: of Fourier series, in the order in which they are tried.
        gravity: direction in which things fall, in the frame of the robot's first row.
        configurations: number of different joint values that were measured.
        varying: names of the conditions that all rows state and that vary.
    """

    harmonics: tuple[int, ...]
    gravity: tuple[float, float, float]
    configurations: int
    varying: tuple[str, ...] = ()


class AbstractFeature(ABC):
    """Columns for every joint: the correction of joint j is `Σ_m weight[j, m] · columns(state)[..., j, m]`.

    A new feature is a subclass in a file of its own and a line in `registry.py`; `register_feature` takes one from
    anywhere. Without `compiled` the models that use it are solved in torch, without `add_onnx` they are not
    exported as ONNX.

    Attributes:
        robot: the nominal robot.
        name: of the feature, as recipes and models write it.
        section: how it stands in the description of a model.
        reads: what it needs of the rows beside the joint values, by the names of `JointState.stated`.
        compiled: its form in the kernels, which gets the numbers of `pack`; None where it has none.
        usually_zero: whether it is 0 where nothing is stated beside the joint values, so that kernels and graphs may
            leave it out.
        used: `(dof, m)`: which columns a joint has; the others are not to be given weights.
        group: `(dof, m)`: number of the prior size that a column's weight has, from 0 on.
        group_names: of the prior sizes.
        size: how large it is among those of its name that are tried in turn, such as its number of harmonics; 0
            where there is only one.
        fastest: its highest harmonic of a joint's value.
    """

    name: ClassVar[str]
    section: ClassVar[type[FeatureSection]] = FeatureSection
    reads: ClassVar[tuple[str, ...]] = ()
    compiled: ClassVar[CompiledForm | None] = None
    usually_zero: ClassVar[bool] = False
    used: Bool[Tensor, "dof columns"]
    group: Int64[Tensor, "dof columns"]
    group_names: tuple[str, ...]
    size: int = 0
    fastest: int = 1

    @property
    def usual_sizes(self) -> tuple[float, ...]:
        """Standard deviations of the weights of every group [rad] with which fits of few rows start.

        They are rather too large than too small, as the evidence takes back quickly what is not needed.
        """
        return (USUAL_SIZE,) * len(self.group_names)

    def __init__(self, robot: Robot) -> None:
        """Prepare for the nominal robot."""
        self.robot = robot

    @abstractmethod
    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """Values of the columns, of the order of 1.

        Args:
            state: joint values [rad or m], and what is stated beside them.
        """

    @classmethod
    def candidates(
        cls: type[Feature], robot: Robot, options: FeatureOptions, state: JointState
    ) -> tuple[Feature, ...]:
        """What a calibrator tries: one feature, ever larger ones, or none where the rows lack what it needs.

        Args:
            robot: the nominal robot.
            options: of the calibrator.
            state: of the rows on which features are chosen.
        """
        return (cls.from_section(robot, cls.section(name=cls.name)),)

    @classmethod
    def from_section(cls: type[Feature], robot: Robot, section: Any) -> Feature:
        """The feature that a section describes, as `describe` gives it.

        Args:
            robot: the nominal robot.
            section: of the type `cls.section`.

        Raises:
            ValueError: the values make no feature.
        """
        return cls(robot, **section.model_dump(exclude={"name"}))

    def describe(self) -> FeatureSection:
        """What `from_section` makes the same feature again from: the attributes that the section names."""
        stated = self.section.model_fields.keys() - {"name"}
        return self.section(name=self.name, **{key: getattr(self, key) for key in stated})

    def pack(self, weight: Float64[np.ndarray, "dof columns"]) -> Float64[np.ndarray, " values"]:
        """The numbers that the compiled form reads, in its own order."""
        return weight.ravel()

    def add_onnx(self, graph: OnnxGraph, weight: Float64[np.ndarray, "dof columns"], q: str) -> str | None:
        """Add the weighted sum of the columns to an ONNX graph.

        Args:
            graph: to add to.
            weight: of the columns.
            q: joint values `(batch, dof)` in the graph.

        Returns:
            Corrections `(batch, dof)` in the graph; None where the feature has no ONNX form.
        """
        return None

    def is_periodic(self, weight: Float64[np.ndarray, "dof columns"]) -> bool:
        """Whether a full turn of a revolute joint changes nothing, with these weights."""
        return True

    def columns_in(self, larger: "AbstractFeature") -> Int64[Tensor, "dof columns"]:
        """Which columns of a feature of the same name and at least this size are the columns of this one."""
        return torch.arange(self.count).expand(self.used.shape)

    @property
    def count(self) -> int:
        """Number of columns of a joint."""
        return self.used.shape[1]

    @property
    def label(self) -> str:
        """What it is called in a table of what was tried."""
        return f"{self.name} {self.size}" if self.size else self.name


def turning_rate(robot: Robot) -> Float[np.ndarray, " dof"]:
    """Angle of a joint's periodic functions per joint value: 1 for a revolute joint [rad/rad].

    A prismatic joint repeats after twice its travel, [rad/m]; without limits its unit of travel is the reach.
    """
    travel = np.diff(robot.limits)[:, 0]
    travel = np.where(np.isfinite(travel) & (travel > 0), travel, max(robot.reach, 1e-3))
    return np.where(robot.revolute, 1.0, np.pi / travel)


def scaled_joints(robot: Robot, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
    """Joint values, 0 in the middle of the limits and ±1 at them; without limits over pi or the reach."""
    limited = np.isfinite(robot.limits).all(1)
    bounds = np.where(limited[:, None], robot.limits, 0.0)
    middle, half = bounds.mean(1), (bounds[:, 1] - bounds[:, 0]) / 2
    half = np.where(limited, half, np.where(robot.revolute, np.pi, robot.reach))
    return (q - q.new_tensor(middle)) / q.new_tensor(half)


def unit_inputs(robot: Robot, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch inputs"]:
    """Inputs of the product units: sines, then cosines of the revolute joints, then scaled prismatic joints."""
    turning = torch.from_numpy(np.flatnonzero(robot.revolute)).to(q.device)
    sliding = torch.from_numpy(np.flatnonzero(~np.asarray(robot.revolute))).to(q.device)
    angle = q.index_select(-1, turning)
    inputs = [angle.sin(), angle.cos()]
    if len(sliding):
        inputs.append(scaled_joints(robot, q).index_select(-1, sliding))
    return torch.cat(inputs, -1)
