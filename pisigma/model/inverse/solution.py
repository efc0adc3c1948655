"""What corrected inverse kinematics gives back, and what it is asked for by what is built on it."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pisigma.model.inverse.joint_input import Postures
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import TaskAxes

if TYPE_CHECKING:  # a name in full, which type checkers at run time find without this import
    import pisigma.model.calibrated_model


class AbstractInverse(ABC):
    """Corrected inverse kinematics as solutions, paths and coupled joints see it; for attributes see `CorrectedIK`."""

    branches: tuple[str, ...]
    joints: tuple[str, ...]
    order: tuple[int, ...]
    limits: np.ndarray
    revolute: np.ndarray
    closed_form: bool

    @property
    @abstractmethod
    def model(self) -> "pisigma.model.calibrated_model.CalibratedModel":
        """What it was made from."""

    @property
    @abstractmethod
    def compiled(self) -> object | None:
        """Its kernels; None where it has none."""

    @property
    @abstractmethod
    def axes(self) -> TaskAxes:
        """Which axes of the tool count."""

    @property
    @abstractmethod
    def postures(self) -> Postures:
        """What `near` may be."""

    @abstractmethod
    def __call__(
        self,
        T_base_tool: Any,
        *,
        near: Any = None,
        branch: str | None = None,
        throw: bool = True,
        approach: Any = None,
    ) -> "Solution":
        """Joint values for poses."""

    @abstractmethod
    def all_branches(self, T_base_tool: Any, *, approach: Any = None) -> "Solution":
        """Joint values on every branch."""

    @abstractmethod
    def forward(self, q: Any, *, approach: Any = None) -> Any:
        """Poses of the calibrated arm."""

    @abstractmethod
    def jacobian(self, q: Any) -> Any:
        """Its Jacobian."""

    @abstractmethod
    def accuracy(self, q: Any) -> Any:
        """Predicted standard deviation of the tool's position [m]."""

    @abstractmethod
    def with_axes(self, axes: TaskAxes) -> "AbstractInverse":
        """The same where other axes of the tool count."""


@dataclass(frozen=True, eq=False)
class Solution:
    """What the robot has to be commanded to reach poses, and how far that can be trusted.

    All values are NumPy arrays (numbers for a single pose) where the poses were arrays or lists, and tensors on the
    poses' device where these were tensors: joint values and `domain_measure` in the dtype of the poses, residuals in
    float64.

    Attributes:
        q: `(*batch, dof)`: corrected joint values [rad or m], NaN where, and only where, the status is UNREACHABLE or
            INVALID_POSE.
        q_nominal: `(*batch, dof)`: joint values of the nominal robot, on the same turns; NaN too where an identified
            geometry reaches the pose and the nominal one, on the same base and with the same tool, does not.
        branch: `(*batch,)`: index into `branches`.
        branches: names of the branches.
        status: `(*batch,)`: a `Status` as a number; the gravest finding counts, in the order unreachable, outside joint
            limits, singular, outside domain, reached. Limits are those of the corrected values, which are commanded.
        position_residual: `(*batch,)`: distance of the tool from the wanted position [m], as far as the model knows and
            before joint values are rounded to float32; NaN without solution.
        rotation_residual: `(*batch,)`: the same of the angle to the wanted orientation [rad]. Both without the
            ignored axes.
        domain_measure: `(*batch,)`: distance to the training rows over their spacing; above 1 the correction is
            extrapolated, whatever the status says. For a hybrid 1 plus the angle [rad] of the joint that is farthest
            beyond its measured values. NaN where nothing is learned or there is no solution.
        owner: whose solution it is, which knows how accurate that is.
        ignored_axes: axes of the tool that do not count, neither for the status nor in the residuals: those that the
            task ignores or, of an arm with fewer than six joints, that are left to the arm by default; see
            `kinematics.task_axes.TaskAxes`.
    """

    q: Any
    q_nominal: Any
    branch: Any
    branches: tuple[str, ...]
    status: Any
    position_residual: Any
    rotation_residual: Any
    domain_measure: Any
    owner: AbstractInverse | None = None
    ignored_axes: tuple[str, ...] = ()

    @property
    def correction(self) -> Any:
        """`q - q_nominal` [rad or m]."""
        return self.q - self.q_nominal

    @cached_property
    def accuracy(self) -> Any:
        """Predicted standard deviation of the tool's position [m], `(*batch,)`; NaN where the model does not know it.

        It is computed with torch when it is first read, in float64.
        """
        return np.full(np.shape(self.status), np.nan) if self.owner is None else self.owner.accuracy(self.q)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What every status means and what to do about it, all batch axes in a row."""
        return tuple(Status(status).sentence for status in np.ravel(self.status).tolist())

    def select(self, index: Any) -> "Solution":
        """The solutions at an index of the first batch axes."""
        return self.map(lambda values: values[index])

    def map(self, change: Callable[..., Any], *others: "Solution") -> "Solution":
        """The same with all values changed by one function, which keeps an axis of joints last.

        Args:
            change: takes values, and the same values of every other solution.
            others: further solutions, of the same branches.
        """
        changed = {
            name: change(*(getattr(solution, name) for solution in (self, *others))) for name in _VALUES
        }
        return replace(self, **changed)


_VALUES = ("q", "q_nominal", "branch", "status", "position_residual", "rotation_residual", "domain_measure")
