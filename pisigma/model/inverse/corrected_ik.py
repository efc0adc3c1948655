"""Corrected inverse kinematics: joint values that really reach a pose."""

import os
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pisigma.files.errors import ModelError, PoseError
from pisigma.files.model_files import COMPILED, model_hash, ready_hash
from pisigma.model.inverse.joint_input import Postures, as_array, checked_approach, pose_array
from pisigma.model.inverse.solution import AbstractInverse, Solution
from pisigma.robot.kernels.array_kinematics import by_torch, is_tensor
from pisigma.robot.kinematics.task_axes import TaskAxes, task_axes

if TYPE_CHECKING:  # names in full, which type checkers at run time find without these imports
    import pytorch_kinematics

    import pisigma.model.calibrated_model
    import pisigma.model.inverse.compiled_ik
    import pisigma.model.inverse.controller_values
    import pisigma.model.inverse.numeric_ik
    import pisigma.model.inverse.path


class CorrectedIK(AbstractInverse):
    """The corrected inverse kinematics of a model: call it with poses.

    Poses go through compiled kernels on the CPU. NumPy arrays and nested lists come back as NumPy arrays, without torch
    being imported; tensors come back as tensors on their own device, with gradients (see `pose_gradients`). A model
    without compiled form, and every one where the machine has no kernels, goes through `NumericIK` instead.

    Attributes:
        name: of the model.
        branches: names of the branches it knows.
        joints: names of the joints.
        order: indices of the branches, those that most training rows lie on first.
        limits: `(dof, 2)` joint limits [rad or m].
        revolute: `(dof,)`: which turn.
        closed_form: whether the nominal robot has a closed-form inverse, so that all branches are known.
        warnings: sentences on conditions of `under` that lie beyond those of the calibration.
        controller: of coupled joints, what turns the controller's values, which are taken and given, into those of the
            joints; else None.
    """

    controller: "pisigma.model.inverse.controller_values.ControllerValues | None"

    def __init__(self, model: "pisigma.model.calibrated_model.CalibratedModel") -> None:
        """Prepare a model for calls.

        Raises:
            ModelError: the model names branches that its robot does not have, or gives the numeric inverse no start.
        """
        from pisigma.model.inverse.numeric_ik import NUMERIC, NumericIK
        from pisigma.model.stated_conditions import condition_warnings

        route = NumericIK(model)
        self.name = model.name
        self.branches, self.order = route.branches, route.order
        self.joints = tuple(joint.name for joint in model.robot.joints)
        self.limits, self.revolute = model.robot.limits, np.array(model.robot.revolute)
        self.closed_form = self.branches != (NUMERIC,)
        self.warnings = condition_warnings(model)
        self.model, self.numeric = model, route
        self._read: Callable[[], pisigma.model.calibrated_model.CalibratedModel] = lambda: model
        self.controller = None
        if model.robot.coupling is not None:
            from pisigma.model.inverse.controller_values import ControllerValues

            axes = model.robot.axes
            of_joints = replace(model, robot=replace(model.robot, coupling=None))
            self.controller = ControllerValues(CorrectedIK(of_joints), model.robot.coupling)
            self.joints, self.limits = tuple(axis.name for axis in axes), model.robot.axis_limits
            self.revolute = np.array([axis.type == "revolute" for axis in axes])

    @classmethod
    def _of_kernels(
        cls,
        kernels: "pisigma.model.inverse.compiled_ik.CompiledIK",
        read: "Callable[[], pisigma.model.calibrated_model.CalibratedModel]",
    ) -> "CorrectedIK":
        """The same of kernels, without the model, which is read when it is asked for."""
        ik = cls.__new__(cls)
        arms, form = kernels.description.arms, kernels.description.closed_form
        ik.name, ik.branches, ik.joints = kernels.name, kernels.branches, kernels.joints
        ik.order = tuple(int(index) for index in form.order)
        ik.limits, ik.revolute = arms.limits, np.asarray(arms.revolute, dtype=bool)
        ik.warnings, ik.controller = (), None
        ik.closed_form = bool(kernels.description.forms.closed_forms)
        ik._read, ik.compiled = read, kernels
        return ik

    @cached_property
    def model(self) -> "pisigma.model.calibrated_model.CalibratedModel":
        """What it was made from."""
        return self._read()

    @cached_property
    def numeric(self) -> "pisigma.model.inverse.numeric_ik.NumericIK":
        """The route without kernels."""
        from pisigma.model.inverse.numeric_ik import NumericIK

        return NumericIK(self.model)

    @cached_property
    def compiled(self) -> "pisigma.model.inverse.compiled_ik.CompiledIK | None":
        """The kernels of the model; None where its correction has no compiled form, or this machine no kernels."""
        from pisigma.model.inverse.compiled_ik import CompiledIK

        try:
            return CompiledIK.of(self.model)
        except ModelError:
            return None

    @cached_property
    def postures(self) -> Postures:
        """What `near` may be."""
        return Postures(self.limits, self.revolute, self.joints)

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
            T_base_tool: `(*batch, 4, 4)` wanted poses of the tool in the base frame [m].
            near: joint values `(*batch, dof)` or `(dof,)` [rad or m], such as the robot's present ones; of the branches
                that reach a pose the nearest is taken, and revolute joints come as near as full turns within the limits
                bring them. Distances count radians and metres alike.
            branch: name of the branch to take; with `near` too, that only chooses the turns. With neither it is the
                first in `order` that reaches the pose, inside the joint limits if there is one.
            throw: False for control loops: a matrix that is no pose, or `near` that is not finite or no posture of the
                robot, raises nothing but gets the status INVALID_POSE and NaN.
            approach: `(*batch, dof)` or `(dof,)`: +1 or -1 for the side from which every joint will come to the pose,
                which matters to joints with backlash; 0, or None for all, where that is not stated.
            ignore_axes: see `for_task`.
            tolerance_mm: see there.
            tolerance_deg: see there.
            elbow_angle: see there [rad].

        Returns:
            One solution per pose: arrays for arrays, in float64; tensors for tensors, in their dtype and on their
            device.

        Raises:
            PoseError: a matrix is no pose, `near` lies far beyond the joint limits, or an argument does not fit.
        """
        task = self.for_task(ignore_axes, tolerance_mm, tolerance_deg, elbow_angle)
        if near is not None:
            near = self.postures.checked(near, throw)
        approach = checked_approach(approach)
        if task.controller is not None:
            return task.controller.solve(T_base_tool, near, self, branch, throw=throw, approach=approach)
        kernels = self.compiled
        if isinstance(T_base_tool, np.ndarray) and T_base_tool.shape == (4, 4) and kernels is not None:
            return kernels.solve(T_base_tool, near, branch, throw, approach, self, task.axes)
        T, single = pose_array(T_base_tool)
        if T.ndim == 2 and not single and kernels is not None:
            solution = kernels.solve(T, near, branch, throw, approach, self, task.axes)
        else:
            solution = (kernels or self.numeric).solve_batch(
                T, near=near, branch=branch, throw=throw, approach=approach, single=single, axes=task.axes
            )
        return self._like(T_base_tool, solution, task.axes)

    def all_branches(self, T_base_tool: Any, *, approach: Any = None) -> Solution:
        """Solutions on every branch, as `(*batch, branches)`; see `__call__` and `for_task`.

        A robot without closed-form inverse gets up to eight different solutions instead, such as those of an elbow to
        either side, where it has kernels, and else one.
        """
        approach = checked_approach(approach)
        if self.controller is not None:
            return self.controller.all_branches(T_base_tool, self, approach=approach)
        T, single = pose_array(T_base_tool)
        route = self.compiled or self.numeric
        every = route.all_branches(T, approach=approach, single=single, axes=self.axes)
        return self._like(T_base_tool, every, self.axes)

    def path(
        self, T_base_tool: Any, *, near: Any = None, branch: str | None = None
    ) -> "pisigma.model.inverse.path.JointPath":
        """Find joint values along a path: one branch as long as possible, and word of every place where that ends.

        From which side every joint comes to a pose follows from the direction in which it moves.

        Args:
            T_base_tool: `(poses, 4, 4)` wanted poses in order [m]; as NumPy array or nested lists.
            near: `(dof,)` joint values [rad or m] where the robot is before the path.
            branch: name of the branch to begin on if that costs no jump.

        Raises:
            PoseError: see `__call__`.
        """
        from pisigma.model.inverse.path import follow_path

        return follow_path(self, T_base_tool, near, branch)

    def forward(self, q: Any, *, approach: Any = None) -> Any:
        """Pose T_base_tool `(*batch, 4, 4)` that the calibrated arm takes at commanded joint values `(*batch, dof)`.

        Args:
            q: joint values [rad or m]; arrays go through kernels without torch, tensors through torch with gradients.
            approach: see `__call__`; for arrays.

        Raises:
            PoseError: q has another number of columns than the robot has joints, or approach does not fit or is given
                where torch evaluates the arm.
        """
        approach = checked_approach(approach)
        if self.controller is not None:
            return self.controller.forward(q, approach)
        kernels = self._kernels_of(q)
        if kernels is None and approach is not None:
            raise PoseError("approach is read with arrays of models that have kernels; give q as an array.")
        if kernels is None:
            return by_torch(self.model.forward, q)
        values = np.asarray(q, dtype=np.float64)
        T = kernels.forward(values.reshape(-1, values.shape[-1]), approach=_flat(approach))[0]
        return T.reshape(*values.shape[:-1], 4, 4)

    def jacobian(self, q: Any) -> Any:
        """Geometric Jacobian `(*batch, 6, dof)` of the calibrated arm, in the base frame at the tool's origin.

        The slope of the correction, some 1e-3, is left out. For the arguments see `forward`; a network that corrects
        nominal joint values is left out too.
        """
        if self.controller is not None:
            return self.controller.jacobian(q)
        kernels = self._kernels_of(q, forward=False)
        if kernels is None:
            return by_torch(self.model.jacobian, q)
        values = np.asarray(q, dtype=np.float64)
        J = kernels.forward(values.reshape(-1, values.shape[-1]))[1]
        return J.reshape(*values.shape[:-1], 6, values.shape[-1])

    def under(self, *, payload_kg: float | None = None, temperature_c: float | None = None) -> "CorrectedIK":
        """The same of the robot under other conditions than the usual ones of the calibration rows.

        Beyond the measured temperatures the correction stays that of the nearest one, and what a payload does is
        continued in proportion; then `warnings` of what is given back says so.

        Args:
            payload_kg: what it carries [kg]; as usual if None.
            temperature_c: of the robot [deg C]; as usual if None.

        Raises:
            ModelError: the model did not learn what a stated condition does, or its value makes no sense.
        """
        from pisigma.model.stated_conditions import under_stated_conditions

        return CorrectedIK(under_stated_conditions(self.model, payload_kg, temperature_c))

    def accuracy(self, q: Any) -> Any:
        """Predicted standard deviation [m] of the tool's position at joint values `(*batch, dof)`, in float64.

        A tensor for a tensor, else an array.
        """
        from pisigma.model.accuracy import position_accuracy

        if self.controller is not None:
            return self.controller.accuracy(q)
        return by_torch(partial(position_accuracy, self.model), q)

    def to_pytorch_kinematics(self) -> "pytorch_kinematics.SerialChain":
        """The geometry as a chain of pytorch-kinematics; see `CalibratedModel.to_pytorch_kinematics`."""
        return self.model.to_pytorch_kinematics()

    def _kernels_of(
        self, q: Any, forward: bool = True
    ) -> "pisigma.model.inverse.compiled_ik.CompiledIK | None":
        """The kernels, where they say where the arm is at such joint values."""
        if is_tensor(q) or self.compiled is None:
            return None
        return None if forward and self.compiled.description.network.used else self.compiled

    @cached_property
    def axes(self) -> TaskAxes:
        """Which axes of the tool count where a call does not state that."""
        if self.controller is not None:
            return self.controller.ik.axes
        return self.numeric.axes if self.compiled is None else self.compiled.axes

    def for_task(
        self,
        ignore_axes: Sequence[str] | None = None,
        tolerance_mm: float | Sequence[float] | None = None,
        tolerance_deg: float | Sequence[float] | None = None,
        elbow_angle: float | None = None,
    ) -> "CorrectedIK":
        """The same for paths, all branches and calls that do not state what is stated here.

        A robot with more joints than axes of the tool count comes as near to `near` as it can; without `near` it keeps
        away from joint limits and singularities.

        Args:
            ignore_axes: axes of the tool's frame that do not count, of "x", "y", "z" (along them) and "roll", "pitch",
                "yaw" (about x, y and z): ("yaw",) for a torch that may turn about its z axis. None: none from six
                joints on, "yaw" with five, with four "roll" and "pitch" up to 10 deg, with three all rotations.
            tolerance_mm: how far the tool may be off along its axes where it cannot reach the pose exactly [mm], one
                number or three; the deviations are then least, each over its tolerance.
            tolerance_deg: the same about its axes [deg]. An axis without tolerance that is not ignored counts exactly.
            elbow_angle: of an arm with seven revolute joints [rad], see `kinematics.task_axes.TaskAxes`.

        Raises:
            PoseError: there is no such axis, a tolerance is none, or the robot has no elbow.
        """
        if ignore_axes is None and tolerance_mm is None and tolerance_deg is None and elbow_angle is None:
            return self
        if elbow_angle is not None and not (
            self.revolute.tolist() == [True] * 7 and np.isfinite(elbow_angle)
        ):
            raise PoseError(
                f"elbow_angle={elbow_angle:g}: only a robot of seven revolute joints has an elbow to turn; give it a "
                "finite angle [rad], and other robots none."
            )
        return self.with_axes(task_axes(self.axes, ignore_axes, tolerance_mm, tolerance_deg, elbow_angle))

    def with_axes(self, axes: TaskAxes) -> "CorrectedIK":
        """The same where other axes of the tool count.

        Raises:
            PoseError: the robot has passive joints, which are solved in the usual axes only.
        """
        ik = copy(self)
        ik.axes = axes
        if self.controller is not None:
            ik.controller = self.controller.with_axes(axes)
        return ik

    def _like(self, poses: Any, solution: Solution, axes: TaskAxes) -> Solution:
        """The solutions of tensors as tensors, with gradients where these are wanted; other ones as arrays."""
        if not is_tensor(poses):
            return replace(solution.map(as_array), owner=self)
        from pisigma.model.inverse.pose_gradients import as_tensors

        return as_tensors(solution, poses, self.model if poses.requires_grad else None, self, axes)


def _flat(values: Any) -> Any:
    """Approaches as rows."""
    return None if values is None else np.asarray(values).reshape(-1, np.shape(values)[-1])


def load(folder: str | os.PathLike[str]) -> CorrectedIK:
    """Load a model folder as corrected inverse kinematics.

    Args:
        folder: what `pisigma calibrate` or `pisigma train` wrote.

    Raises:
        ModelError: the folder is no whole model; the message says what is wrong with which file.
    """
    path = Path(folder)
    kernels = _stored_kernels(path)
    if kernels is None:
        from pisigma.model.folder.model_folder import load_model

        return CorrectedIK(load_model(path))
    stated = model_hash(path)

    def read() -> "pisigma.model.calibrated_model.CalibratedModel":
        from pisigma.model.folder.model_folder import load_model

        if model_hash(path) != stated:
            raise ModelError(f"{path}: was changed after it was loaded; load it again.")
        return load_model(path)

    return CorrectedIK._of_kernels(kernels, read)


def _stored_kernels(path: Path) -> "pisigma.model.inverse.compiled_ik.CompiledIK | None":
    """What stands ready in a model folder; None where that is missing, damaged or of another state of the model."""
    stated = ready_hash(path)
    if stated is None:
        return None
    from pisigma.model.inverse.compiled_ik import CompiledIK

    try:
        kernels = CompiledIK.load(path / COMPILED)
    except ModelError:
        return None
    return kernels if kernels.belongs_to == stated else None
