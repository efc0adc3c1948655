"""Interface of features, functions of the joint values whose weighted sum is the correction of a joint."""

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
"""Default prior standard deviation of weights [rad]."""
Feature = TypeVar("Feature", bound="AbstractFeature")


class FeatureSection(Section):
    """Section of a feature in the description of a model: the name, and further values in subclasses."""

    name: str


@dataclass(frozen=True)
class FeatureOptions:
    """Options of a calibrator that determine which features it tries.

    Attributes:
        harmonics: numbers of harmonics of Fourier series, in the order in which they are tried.
        gravity: direction of gravity in the frame of the robot's first row.
        configuration_count: number of different joint values that were measured.
        varying_conditions: names of the conditions that all rows state and that vary.
    """

    harmonics: tuple[int, ...]
    gravity: tuple[float, float, float]
    configuration_count: int
    varying_conditions: tuple[str, ...] = ()


class AbstractFeature(ABC):
    """Feature with columns for every joint; it corrects joint j by `Σ_m weight[j, m] · columns(state)[..., j, m]`.

    A new feature is a subclass in its own file and a line in `registry.py`; `register_feature` adds features of
    plug-ins. Models that contain a feature without `compiled` are solved in torch; models that contain a feature
    without `add_onnx` cannot be exported as ONNX.

    Attributes:
        robot: the nominal robot.
        name: name of the feature in recipes and models.
        section: class of the feature's section in the description of a model.
        compiled: compiled form for the kernels, which read the numbers of `pack`; None if the feature has no compiled
            form.
        usually_zero: whether the correction is 0 if only joint values are stated, so that kernels and graphs may
            omit the feature.
        used: `(dof, m)`: mask of the columns that a joint uses; weights of other columns must be 0.
        group: `(dof, m)`: index of the prior scale of a column's weight, from 0.
        group_names: names of the groups of weights that have a common prior scale.
        size: size among features of the same name that are tried one after another, such as the number of harmonics; 0
            if there is only one.
        highest_harmonic: highest harmonic of a joint value in the columns.
    """

    name: ClassVar[str]
    section: ClassVar[type[FeatureSection]] = FeatureSection
    compiled: ClassVar[CompiledForm | None] = None
    usually_zero: ClassVar[bool] = False
    used: Bool[Tensor, "dof columns"]
    group: Int64[Tensor, "dof columns"]
    group_names: tuple[str, ...]
    size: int = 0
    highest_harmonic: int = 1

    @property
    def usual_sizes(self) -> tuple[float, ...]:
        """Initial standard deviations of the weights of every group [rad] for fits of few rows.

        They should be too large rather than too small, because the evidence quickly reduces sizes that are too large.
        """
        return (USUAL_SIZE,) * len(self.group_names)

    def __init__(self, robot: Robot) -> None:
        """Create the feature for a nominal robot."""
        self.robot = robot

    @abstractmethod
    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """Compute the columns of every joint; the values are of the order of 1.

        Args:
            state: joint values [rad or m], and further data of the rows.
        """

    def columns_of_rows(self, state: JointState) -> Float[Tensor, "rows dof columns"]:
        """Return the columns of measured rows, which may be stored: no derivative passes through them."""
        return self.columns(state)

    def unstated_covariance_root(
        self, state: JointState, weight: Float64[Tensor, "dof columns"]
    ) -> Float[Tensor, "*batch dof sources"]:
        """Return a root R of the covariance R R^T of the corrections [rad or m] due to unstated conditions of rows.

        Args:
            state: joint states; see `columns`.
            weight: weights of the columns.
        """
        return state.q.new_zeros((*state.q.shape, 0))

    @classmethod
    def candidates(
        cls: type[Feature], robot: Robot, options: FeatureOptions, state: JointState
    ) -> tuple[Feature, ...]:
        """Return the features that a calibrator tries: one, several of increasing size, or none if data are missing.

        Args:
            robot: the nominal robot.
            options: options of the calibrator.
            state: joint states of the rows on which features are selected.
        """
        return (cls.from_section(robot, cls.section(name=cls.name)),)

    @classmethod
    def from_section(cls: type[Feature], robot: Robot, section: Any) -> Feature:
        """Return the feature that a section describes; the inverse of `describe`.

        Args:
            robot: the nominal robot.
            section: section of the class `cls.section`.

        Raises:
            ValueError: the values are not valid for the feature.
        """
        return cls(robot, **section.model_dump(exclude={"name"}))

    def describe(self) -> FeatureSection:
        """Return the section from which `from_section` restores the feature."""
        stated = self.section.model_fields.keys() - {"name"}
        return self.section(name=self.name, **{key: getattr(self, key) for key in stated})

    def pack(self, weight: Float64[np.ndarray, "dof columns"]) -> Float64[np.ndarray, " values"]:
        """Return the numbers that the compiled form reads."""
        return weight.ravel()

    def add_onnx(self, graph: OnnxGraph, weight: Float64[np.ndarray, "dof columns"], q: str) -> str | None:
        """Add the weighted sum of the columns to an ONNX graph.

        Args:
            graph: graph to extend.
            weight: weights of the columns.
            q: name of the joint values `(batch, dof)` in the graph.

        Returns:
            Name of the corrections `(batch, dof)` in the graph; None if the feature has no ONNX form.
        """
        return None

    def is_periodic(self, weight: Float64[np.ndarray, "dof columns"]) -> bool:
        """Return whether the correction with these weights is the same after a full turn of a revolute joint."""
        return True

    def columns_in(self, larger: "AbstractFeature") -> Int64[Tensor, "dof columns"]:
        """Return the indices of this feature's columns in a feature of the same name and at least the same size."""
        return torch.arange(self.column_count).expand(self.used.shape)

    @property
    def column_count(self) -> int:
        """Number of columns per joint."""
        return self.used.shape[1]

    @property
    def label(self) -> str:
        """Name of the feature in tables."""
        return f"{self.name} {self.size}" if self.size else self.name


def angle_per_joint_value(robot: Robot) -> Float[np.ndarray, " dof"]:
    """Return the angle of a joint's periodic functions per joint value: 1 for a revolute joint [rad/rad].

    For a prismatic joint [rad/m], the period is twice its travel, or twice the reach if it has no limits.
    """
    travel = np.diff(robot.limits)[:, 0]
    travel = np.where(np.isfinite(travel) & (travel > 0), travel, max(robot.reach, 1e-3))
    return np.where(robot.revolute, 1.0, np.pi / travel)


def scaled_joints(robot: Robot, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
    """Scale joint values to ±1 at the limits and 0 midway; without limits, divide by pi or the reach."""
    limited = np.isfinite(robot.limits).all(1)
    bounds = np.where(limited[:, None], robot.limits, 0.0)
    middle, half = bounds.mean(1), (bounds[:, 1] - bounds[:, 0]) / 2
    half = np.where(limited, half, np.where(robot.revolute, np.pi, robot.reach))
    return (q - q.new_tensor(middle)) / q.new_tensor(half)


def product_unit_inputs(robot: Robot, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch inputs"]:
    """Compute the inputs of the product units: sines, then cosines of revolute joints, then scaled prismatic joints."""
    turning = torch.from_numpy(np.flatnonzero(robot.revolute)).to(q.device)
    sliding = torch.from_numpy(np.flatnonzero(~np.asarray(robot.revolute))).to(q.device)
    angle = q.index_select(-1, turning)
    inputs = [angle.sin(), angle.cos()]
    if len(sliding):
        inputs.append(scaled_joints(robot, q).index_select(-1, sliding))
    return torch.cat(inputs, -1)
