"""Solutions of corrected inverse kinematics, and the interface of its solvers."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pisigma.model.inverse.joint_input import PlausibleJoints
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import TaskAxes

if TYPE_CHECKING:  # run-time type checkers resolve the full name without this import
    import pisigma.model.calibrated_model


class AbstractInverse(ABC):
    """Interface of solvers of corrected inverse kinematics; see `CorrectedIK` for the attributes."""

    name: str
    branches: tuple[str, ...]
    joints: tuple[str, ...]
    branch_order: tuple[int, ...]
    limits: np.ndarray
    revolute: np.ndarray
    closed_form: bool

    @property
    @abstractmethod
    def model(self) -> "pisigma.model.calibrated_model.CalibratedModel":
        """The calibrated model."""

    @property
    @abstractmethod
    def compiled(self) -> object | None:
        """The compiled kernels; None if there are none."""

    @property
    @abstractmethod
    def task_axes(self) -> TaskAxes:
        """Axes of the tool that are constrained."""

    @property
    @abstractmethod
    def plausible_joints(self) -> PlausibleJoints:
        """Ranges of plausible joint values, in which `near` must lie."""

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
        """Find corrected joint values [rad or m] for poses T_base_tool [m]."""

    @abstractmethod
    def all_branches(self, T_base_tool: Any, *, approach: Any = None) -> "Solution":
        """Find corrected joint values on every branch for poses T_base_tool [m]."""

    @abstractmethod
    def forward(self, q: Any, *, approach: Any = None) -> Any:
        """Compute poses T_base_tool [m] of the calibrated arm at joint values q [rad or m]."""

    @abstractmethod
    def jacobian(self, q: Any) -> Any:
        """Compute the geometric Jacobian of the calibrated arm at joint values q [rad or m]."""

    @abstractmethod
    def accuracy(self, q: Any, *, approach: Any = None) -> Any:
        """Predict the standard deviation of the tool's position [m], `sqrt(σx² + σy² + σz²)`."""

    @abstractmethod
    def with_axes(self, axes: TaskAxes) -> "AbstractInverse":
        """Return a copy in which other axes of the tool are constrained."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Joint values to command in order to reach poses, and measures of their validity.

    All values are NumPy arrays (scalars for a single pose) if the poses were arrays or lists, and tensors on the device
    of the poses if these were tensors: joint values and `domain_measure` in the dtype of the poses, residuals in
    float64.

    Attributes:
        q: `(*batch, dof)`: corrected joint values [rad or m]; NaN if and only if the status is UNREACHABLE or
            INVALID_POSE.
        q_nominal: `(*batch, dof)`: joint values of the nominal robot, wrapped near `q`; also NaN where the identified
            geometry reaches the pose but the nominal geometry does not.
        branch: `(*batch,)`: index into `branches`.
        branches: names of the branches.
        status: `(*batch,)`: a `Status` as a number. The most serious status is reported, in the order unreachable,
            outside joint limits, singular, outside domain, reached. Joint limits apply to the corrected values, because
            these are commanded.
        position_residual: `(*batch,)`: distance of the tool from the target position [m] as predicted by the model,
            before joint values are rounded to float32, and without the ignored axes; NaN if there is no solution.
        rotation_residual: `(*batch,)`: angle between the tool and the target orientation [rad], computed in the same
            way.
        domain_measure: `(*batch,)`: distance to the training rows divided by their spacing; above 1, the correction is
            extrapolated, regardless of the status. For a hybrid, it is 1 plus the largest angle [rad] by which a joint
            is outside its measured values. NaN if there is no learned correction or no solution.
        owner: solver that found the solution and predicts its accuracy.
        ignored_axes: axes of the tool that affect neither the status nor the residuals, because the task ignores them
            or an arm with fewer than six joints cannot control them; see `kinematics.task_axes.TaskAxes`.
        approach: `(*batch, dof)`: direction of approach that the call stated for every joint, as an array; None if the
            call stated none.
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
    approach: Any = None

    @property
    def correction(self) -> Any:
        """Correction of the joint values, `q - q_nominal` [rad or m]."""
        return self.q - self.q_nominal

    @property
    def model(self) -> str:
        """Name of the model that was used; empty if unknown."""
        return "" if self.owner is None else self.owner.name

    @cached_property
    def accuracy(self) -> Any:
        """Predicted standard deviation `sqrt(σx² + σy² + σz²)` of the position [m], `(*batch,)`; NaN if unknown.

        It is computed with torch in float64 on first access.
        """
        if self.owner is None:
            return np.full(np.shape(self.status), np.nan)
        return self.owner.accuracy(self.q, approach=self.approach)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentence on the meaning of every status and on what to do, with flattened batch axes."""
        return tuple(Status(status).sentence for status in np.ravel(self.status).tolist())

    def select(self, index: Any) -> "Solution":
        """Return the solutions at an index of the first batch axes."""
        chosen = self.map(lambda values: values[index])
        return chosen if self.approach is None else replace(chosen, approach=self.approach[index])

    def with_approach(self, approach: Any, has_branch_axis: bool = False) -> "Solution":
        """Return the solutions for directions of approach.

        Args:
            approach: `(*batch, dof)` or `(dof,)`; None if not stated.
            has_branch_axis: whether the solutions have an axis of branches after the batch axes.
        """
        if approach is None:
            return self
        stated = approach[..., None, :] if has_branch_axis and np.ndim(approach) > 1 else approach
        return replace(self, approach=np.broadcast_to(stated, self.q.shape))

    def map(self, change: Callable[..., Any], *others: "Solution") -> "Solution":
        """Return the solutions after applying a function, which must keep the joint axis last, to all values.

        Args:
            change: function of the values of this solution and of every other solution.
            others: other solutions, with the same branches.
        """
        changed = {
            name: change(*(getattr(solution, name) for solution in (self, *others))) for name in _VALUES
        }
        return replace(self, **changed)


_VALUES = ("q", "q_nominal", "branch", "status", "position_residual", "rotation_residual", "domain_measure")
