"""Corrected inverse kinematics: joint values at which the real robot reaches a pose."""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pisigma.files.errors import ModelError, PoseError
from pisigma.model.inverse.joint_input import PlausibleJoints, as_array, checked_approach, pose_array
from pisigma.model.inverse.solution import AbstractInverse, Solution
from pisigma.robot.kernels.array_kinematics import call_model, is_tensor
from pisigma.robot.kinematics.task_axes import TaskAxes, task_axes

if TYPE_CHECKING:  # run-time type checkers resolve the full names without these imports
    import pytorch_kinematics

    import pisigma.model.calibrated_model
    import pisigma.model.inverse.compiled_ik
    import pisigma.model.inverse.controller_values
    import pisigma.model.inverse.numeric_ik
    import pisigma.model.inverse.path


class CorrectedIK(AbstractInverse):
    """Corrected inverse kinematics of a model; call it with poses.

    Poses are solved by compiled kernels on the CPU. For NumPy arrays and nested lists, the solutions are NumPy arrays,
    and torch is not imported; for tensors, they are tensors on the same device, with gradients (see `numeric_arm`).
    Models without a compiled form, and all models on machines without kernels, are solved by `NumericIK` instead.

    Attributes:
        name: name of the model.
        branches: names of the branches.
        joints: names of the joints.
        branch_order: indices of the branches, in order of decreasing numbers of training rows.
        limits: `(dof, 2)` joint limits [rad or m].
        revolute: `(dof,)` mask of the revolute joints.
        closed_form: whether the nominal robot has a closed-form inverse, so that all branches are known.
        warnings: warnings about conditions given to `under` outside the range of the calibration, modelled torques, or
            several targets or frames of which only the first is used.
        controller_solver: conversion to the controller's values for coupled joints; None if there are none.
    """

    controller_solver: "pisigma.model.inverse.controller_values.ControllerValuesSolver | None"

    def __init__(self, model: "pisigma.model.calibrated_model.CalibratedModel") -> None:
        """Prepare a model for calls.

        Raises:
            ModelError: the model states unknown branches of its robot, or no initial values for the numeric inverse.
        """
        from pisigma.model.frame_choice import warnings_without_rows
        from pisigma.model.inverse.numeric_ik import NUMERIC, NumericIK

        route = NumericIK(model)
        self.name, self.branches, self.branch_order = model.name, route.branches, route.branch_order
        self.joints = tuple(joint.name for joint in model.robot.joints)
        self.limits, self.revolute = model.robot.limits, np.array(model.robot.revolute)
        self.closed_form = self.branches != (NUMERIC,)
        self.warnings = warnings_without_rows(model)
        self.model, self.numeric = model, route
        self._read: Callable[[], pisigma.model.calibrated_model.CalibratedModel] = lambda: model
        self.controller_solver = None
        if model.robot.coupling is not None:
            from pisigma.model.inverse.controller_values import ControllerValuesSolver

            axes = model.robot.axes
            of_joints = replace(model, robot=replace(model.robot, coupling=None))
            self.controller_solver = ControllerValuesSolver(CorrectedIK(of_joints), model.robot.coupling)
            self.joints, self.limits = tuple(axis.name for axis in axes), model.robot.axis_limits
            self.revolute = np.array([axis.type == "revolute" for axis in axes])

    @classmethod
    def _of_kernels(
        cls,
        kernels: "pisigma.model.inverse.compiled_ik.CompiledIK",
        read: "Callable[[], pisigma.model.calibrated_model.CalibratedModel]",
    ) -> "CorrectedIK":
        """Return the inverse kinematics from kernels alone; `read` loads the model when it is first needed."""
        ik = cls.__new__(cls)
        arms, form = kernels.description.arms, kernels.description.closed_form
        ik.name, ik.branches, ik.joints = kernels.name, kernels.branches, kernels.joints
        ik.branch_order = tuple(int(index) for index in form.order)
        ik.limits, ik.revolute = arms.limits, np.asarray(arms.revolute, dtype=bool)
        ik.warnings, ik.controller_solver = kernels.warnings, None
        ik.closed_form = bool(kernels.description.forms.closed_forms)
        ik._read, ik.compiled = read, kernels
        return ik

    @cached_property
    def model(self) -> "pisigma.model.calibrated_model.CalibratedModel":
        """The calibrated model."""
        return self._read()

    @cached_property
    def numeric(self) -> "pisigma.model.inverse.numeric_ik.NumericIK":
        """Solver in torch, without kernels."""
        from pisigma.model.inverse.numeric_ik import NumericIK

        return NumericIK(self.model)

    @cached_property
    def compiled(self) -> "pisigma.model.inverse.compiled_ik.CompiledIK | None":
        """Kernels of the model; None if its correction has no compiled form, or this machine has no kernels."""
        from pisigma.model.inverse.compiled_ik import CompiledIK

        try:
            return CompiledIK.from_model(self.model)
        except ModelError:
            return None

    @cached_property
    def plausible_joints(self) -> PlausibleJoints:
        """Ranges of plausible joint values, in which `near` must lie."""
        return PlausibleJoints(self.limits, self.revolute, self.joints)

    def __call__(
        self,
        T_base_tool: Any,
        *,
        near: Any = None,
        branch: str | None = None,
        throw: bool = True,
        approach: Any = None,
        ignore_axes: Sequence[str] | None = None,
        tolerance_mm: float | Sequence[float] | None = None,
        tolerance_deg: float | Sequence[float] | None = None,
        elbow_angle: float | None = None,
    ) -> Solution:
        """Find corrected joint values for poses.

        Args:
            T_base_tool: `(*batch, 4, 4)` target poses of the tool in the frame of the measurements [m].
            near: joint values `(*batch, dof)` or `(dof,)` [rad or m], for example the robot's current joint values.
                Among the branches that reach a pose, the nearest is chosen, and revolute joints are wrapped as near to
                `near` as their limits allow. Distances add radians and metres with equal weight.
            branch: name of the branch to use; `near` then only affects how joint values are wrapped. The default is
                the first branch in `branch_order` that reaches the pose, preferably inside the joint limits.
            throw: False for control loops: an invalid pose, or a `near` that is not finite or plausible for the robot,
                then raises no error; its solution is NaN with the status INVALID_POSE.
            approach: `(*batch, dof)` or `(dof,)`: +1 or -1 for the direction in which every joint moves to the pose,
                which affects joints with backlash; 0 for a joint, or None for all, if it is unknown.
            ignore_axes: see `for_task`.
            tolerance_mm: see `for_task`.
            tolerance_deg: see `for_task`.
            elbow_angle: see `for_task` [rad].

        Returns:
            One solution per pose: float64 arrays for arrays; for tensors, tensors of the same dtype and device.

        Raises:
            PoseError: a matrix is not a valid pose, `near` is far outside the joint limits, or an argument is invalid.
        """
        task = self.for_task(ignore_axes, tolerance_mm, tolerance_deg, elbow_angle)
        axes = task.task_axes
        if near is not None:
            near = self.plausible_joints.check_near(near, throw)
        approach = checked_approach(approach)
        if (solver := task.controller_solver) is not None:
            return solver.solve(T_base_tool, near, self, branch, throw=throw, approach=approach)
        kernels = self.compiled
        if isinstance(T_base_tool, np.ndarray) and T_base_tool.shape == (4, 4) and kernels is not None:
            return kernels.solve(T_base_tool, near, branch, throw, approach, self, axes)
        T, single, tensor = pose_array(T_base_tool)
        if T.ndim == 2 and not single and kernels is not None:
            solution = kernels.solve(T, near, branch, throw, approach, self, axes)
        else:
            solution = (kernels or self.numeric).solve_batch(
                T, near=near, branch=branch, throw=throw, approach=approach, is_float32=single, axes=axes
            )
        return self._like(tensor, solution, axes).with_approach(approach)

    def all_branches(self, T_base_tool: Any, *, approach: Any = None) -> Solution:
        """Find solutions on every branch, as `(*batch, branches)`; see `__call__` and `for_task`.

        Without a closed-form inverse, kernels find up to eight distinct solutions.
        """
        approach = checked_approach(approach)
        if self.controller_solver is not None:
            return self.controller_solver.all_branches(T_base_tool, self, approach=approach)
        T, single, tensor = pose_array(T_base_tool)
        route = self.compiled or self.numeric
        every = route.all_branches(T, approach=approach, is_float32=single, axes=self.task_axes)
        return self._like(tensor, every, self.task_axes).with_approach(approach, has_branch_axis=True)

    def path(
        self, T_base_tool: Any, *, near: Any = None, branch: str | None = None
    ) -> "pisigma.model.inverse.path.JointPath":
        """Find joint values along a path on as few branches as possible, with a report of every discontinuity.

        The approach direction of every joint follows from its motion along the path.

        Args:
            T_base_tool: `(poses, 4, 4)` target poses in order [m], as a NumPy array or nested lists.
            near: `(dof,)` joint values [rad or m] of the robot before the path.
            branch: name of the branch to start on, if this causes no jump.

        Raises:
            PoseError: see `__call__`.
        """
        from pisigma.model.inverse.path import follow_path

        return follow_path(self, T_base_tool, near, branch)

    def forward(self, q: Any, *, approach: Any = None) -> Any:
        """Compute poses T_base_tool `(*batch, 4, 4)` of the calibrated arm at commanded joint values `(*batch, dof)`.

        Args:
            q: joint values [rad or m]. Arrays use kernels; tensors use torch, with gradients, their dtype and device.
            approach: see `__call__`; accepted only for arrays.

        Raises:
            PoseError: q does not match the robot's joints, or `approach` is invalid or given where torch is used.
        """
        approach = checked_approach(approach)
        if self.controller_solver is not None:
            return self.controller_solver.forward(q, approach)
        kernels = self._kernels_of(q)
        if kernels is None and approach is not None:
            raise PoseError(
                "the argument requires an array and a model with compiled kernels",
                option="approach",
                remedy="give q as an array",
            )
        if kernels is None:
            return call_model(self.model.forward, q)
        values = np.asarray(q, dtype=np.float64)
        sides = None if approach is None else np.reshape(approach, (-1, np.shape(approach)[-1]))
        T = kernels.forward(values.reshape(-1, values.shape[-1]), approach=sides)[0]
        return T.reshape(*values.shape[:-1], 4, 4)

    def jacobian(self, q: Any) -> Any:
        """Compute the geometric Jacobian `(*batch, 6, dof)` of the calibrated arm, at the tool in the base frame.

        The slope of the correction, about 1e-3, and a network on nominal joint values are neglected. See `forward`.
        """
        if self.controller_solver is not None:
            return self.controller_solver.jacobian(q)
        kernels = self._kernels_of(q, forward=False)
        if kernels is None:
            return call_model(self.model.jacobian, q)
        values = np.asarray(q, dtype=np.float64)
        J = kernels.forward(values.reshape(-1, values.shape[-1]))[1]
        return J.reshape(*values.shape[:-1], 6, values.shape[-1])

    def under(self, *, payload_kg: float | None = None, temperature_c: float | None = None) -> "CorrectedIK":
        """Return the corrected inverse kinematics at a given payload or temperature instead of their means.

        Outside the measured range, the correction is that of the nearest measured temperature, and the effect of the
        payload is extrapolated linearly; `warnings` of the result then states this.

        Args:
            payload_kg: mass that the robot carries [kg]; None for the mean of the calibration rows.
            temperature_c: temperature of the robot [deg C]; None for the mean of the calibration rows.

        Raises:
            ModelError: the model did not learn the effect of a given condition, or the value is impossible.
        """
        from pisigma.model.stated_conditions import under_stated_conditions

        return self._with_model(under_stated_conditions(self.model, payload_kg, temperature_c))

    def for_target(self, target: str | None = None, *, frame: str | None = None) -> "CorrectedIK":
        """Return the corrected inverse kinematics for poses of another target, or in another frame.

        Args:
            target: name of a target of the calibration rows; None for the current one, at first that of the first row.
            frame: name of a frame of the calibration rows; None for the current one.

        Raises:
            ModelError: the model was not calibrated for this target or frame.
        """
        from pisigma.model.frame_choice import with_frame_and_target

        return self._with_model(with_frame_and_target(self.model, frame, target))

    def _with_model(self, model: "pisigma.model.calibrated_model.CalibratedModel") -> "CorrectedIK":
        """Return the inverse kinematics of a variant of the model, for the same task and with warnings of the cell."""
        from pisigma.model.frame_choice import warnings_without_rows

        ik, of_model = CorrectedIK(model), warnings_without_rows(self.model)
        ik.warnings += tuple(warning for warning in self.warnings if warning not in of_model)
        return ik if self.task_axes == ik.task_axes else ik.with_axes(self.task_axes)

    def accuracy(self, q: Any, *, approach: Any = None) -> Any:
        """Predict the standard deviation [m] of the tool's position at joint values `(*batch, dof)`; see `__call__`.

        It includes half the backlash of joints whose direction of approach is not stated.
        """
        from pisigma.model.accuracy import position_accuracy

        approach = checked_approach(approach)
        if self.controller_solver is not None:
            return self.controller_solver.accuracy(q, approach)
        return call_model(partial(position_accuracy, self.model, approach=approach), q)

    def to_pytorch_kinematics(self) -> "pytorch_kinematics.SerialChain":
        """Return the geometry as a chain of pytorch-kinematics; see `CalibratedModel.to_pytorch_kinematics`."""
        return self.model.to_pytorch_kinematics()

    def _kernels_of(
        self, q: Any, forward: bool = True
    ) -> "pisigma.model.inverse.compiled_ik.CompiledIK | None":
        """Return the kernels if they can evaluate the arm at these joint values, otherwise None."""
        if is_tensor(q) or self.compiled is None:
            return None
        return None if forward and self.compiled.description.network.used else self.compiled

    @cached_property
    def task_axes(self) -> TaskAxes:
        """Axes of the tool that are constrained unless a call states others."""
        if self.controller_solver is not None:
            return self.controller_solver.ik.task_axes
        return self.numeric.task_axes if self.compiled is None else self.compiled.task_axes

    def for_task(
        self,
        ignore_axes: Sequence[str] | None = None,
        tolerance_mm: float | Sequence[float] | None = None,
        tolerance_deg: float | Sequence[float] | None = None,
        elbow_angle: float | None = None,
    ) -> "CorrectedIK":
        """Return a copy for a task that leaves axes of the tool free, which applies to calls, branches and paths.

        For a robot with more joints than constrained axes, the joint values are as near to `near` as possible or,
        without `near`, away from joint limits and singularities.

        Args:
            ignore_axes: axes of the tool's frame that are not constrained, among "x", "y", "z" (translations along
                them) and "roll", "pitch", "yaw" (rotations about x, y and z), such as ("yaw",) for a torch that may
                rotate about its z axis. None ignores no axis for robots with six or more joints, "yaw" for five, "roll"
                and "pitch" up to 10 deg for four, and all rotations for three.
            tolerance_mm: accepted deviations along the tool's axes if the pose cannot be reached exactly [mm], one
                number or three. The deviations, each divided by its tolerance, are then minimised.
            tolerance_deg: accepted rotations about the tool's axes if the pose cannot be reached exactly [deg], one
                number or three. Other axes are met exactly unless they are ignored.
            elbow_angle: elbow angle of an arm with seven revolute joints [rad], see `kinematics.task_axes.TaskAxes`.

        Raises:
            PoseError: the axis is unknown, a tolerance is invalid, or the robot has no elbow.
        """
        if ignore_axes is None and tolerance_mm is None and tolerance_deg is None and elbow_angle is None:
            return self
        has_elbow = self.revolute.tolist() == [True] * 7
        if elbow_angle is not None and not (has_elbow and np.isfinite(elbow_angle)):
            raise PoseError(
                expected="a finite angle [rad], for a robot with seven revolute joints",
                value=elbow_angle,
                option="elbow_angle",
                remedy="omit it for other robots",
            )
        axes = task_axes(self.task_axes, ignore_axes, tolerance_mm, tolerance_deg, elbow_angle)
        return self.with_axes(axes)

    def with_axes(self, axes: TaskAxes) -> "CorrectedIK":
        """Return a copy in which other axes of the tool are constrained.

        Raises:
            PoseError: the robot has passive joints, which are solved only in the default axes.
        """
        ik = copy(self)
        ik.task_axes = axes
        if self.controller_solver is not None:
            ik.controller_solver = self.controller_solver.with_axes(axes)
        return ik

    def _like(self, poses: Any, solution: Solution, axes: TaskAxes) -> Solution:
        """Return solutions as tensors, with gradients if required, if the poses are tensors, otherwise as arrays."""
        if poses is None:
            return replace(solution.map(as_array), owner=self)
        from pisigma.model.inverse.numeric_arm import as_tensor, in_type_of_poses

        tensors = replace(solution.map(as_tensor), owner=self)
        return in_type_of_poses(tensors, poses, self.model if poses.requires_grad else None, axes)
