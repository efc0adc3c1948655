"""Corrected inverse kinematics: joint values that really reach a pose."""

import os
import sys
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pisigma.errors import ModelError, PoseError
from pisigma.inverse.posture import Postures
from pisigma.model.folder.folder_files import COMPILED, folder_hash

if TYPE_CHECKING:  # names in full, which type checkers at run time find without these imports
    import pytorch_kinematics

    import pisigma.inverse.path
    import pisigma.inverse.solution
    import pisigma.inverse.torch_ik
    import pisigma.kernels.solution
    import pisigma.kernels.solver
    import pisigma.model.calibrated_model


class CorrectedIK:
    """The corrected inverse kinematics of a model: call it with poses.

    Behind one call there are two routes, which give the same solutions. NumPy arrays and nested lists go through
    compiled kernels on the CPU, without torch being imported, and come back as NumPy arrays. Tensors go through torch,
    with gradients by the implicit function theorem, and come back as tensors on their own device.

    Attributes:
        name: of the model.
        branches: names of the branches it knows.
        joints: names of the joints.
        order: indices of the branches, those that most training rows lie on first.
        limits: `(dof, 2)` joint limits [rad or m].
        revolute: `(dof,)`: which joints turn.
        closed_form: whether the nominal robot has a closed-form inverse, so that all branches are known.
    """

    def __init__(self, model: "pisigma.model.calibrated_model.CalibratedModel") -> None:
        """Prepare a model for calls.

        Raises:
            ModelError: the model names branches that its robot does not have, or gives the numeric inverse no start.
        """
        from pisigma.inverse.torch_ik import NUMERIC, TorchIK

        route = TorchIK(model)
        self.name = model.name
        self.branches = route.branches
        first = [self.branches.index(name) for name in model.branches]
        self.order = (*first, *(index for index in range(len(self.branches)) if index not in first))
        self.joints = tuple(joint.name for joint in model.robot.joints)
        self.limits, self.revolute = model.robot.limits, np.array(model.robot.revolute)
        self.closed_form = self.branches != (NUMERIC,)
        self.model, self.torch = model, route
        self._read: Callable[[], pisigma.model.calibrated_model.CalibratedModel] = lambda: model

    @classmethod
    def _of_kernels(
        cls,
        kernels: "pisigma.kernels.solver.CompiledIK",
        read: "Callable[[], pisigma.model.calibrated_model.CalibratedModel]",
    ) -> "CorrectedIK":
        """The same of kernels, without the model, which is read when it is asked for."""
        found = cls.__new__(cls)
        arms, form = kernels.description.arms, kernels.description.closed_form
        found.name, found.branches, found.joints = kernels.name, kernels.branches, kernels.joints
        found.order = tuple(int(index) for index in form.order)
        found.limits, found.revolute = arms.limits, np.asarray(arms.revolute, dtype=bool)
        found.closed_form = form.kind != 0
        found._read, found.compiled = read, kernels
        return found

    @cached_property
    def model(self) -> "pisigma.model.calibrated_model.CalibratedModel":
        """What it was made from."""
        return self._read()

    @cached_property
    def torch(self) -> "pisigma.inverse.torch_ik.TorchIK":
        """The route for tensors."""
        from pisigma.inverse.torch_ik import TorchIK

        return TorchIK(self.model)

    @cached_property
    def compiled(self) -> "pisigma.kernels.solver.CompiledIK | None":
        """The route for arrays; None where the model corrects by something that has no compiled form."""
        from pisigma.model.compiled_model import compile_model

        try:
            return compile_model(self.model)
        except ModelError:
            return None

    def __call__(
        self, T_base_tool: Any, *, near: Any = None, branch: str | None = None, throw: bool = True
    ) -> "pisigma.inverse.solution.Solution | pisigma.kernels.solution.CompiledSolution":
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

        Returns:
            One solution per pose: arrays for arrays, in float64; tensors for tensors, in their dtype and on their
            device.

        Raises:
            PoseError: a matrix is no pose, `near` does not fit or lies far beyond the joint limits, or the branch is
                unknown.
        """
        if near is not None:
            near = self.postures.checked(near, _is_tensor(near), throw)
        kernels = None if _is_tensor(T_base_tool) else self.compiled
        if kernels is not None:
            return self._by_kernels(kernels, T_base_tool, near, branch, throw)
        if throw:
            found = self.torch(T_base_tool, near=near, branch=branch)
        else:
            from pisigma.inverse.lenient import solve_what_can_be

            found = solve_what_can_be(self.torch, T_base_tool, near, branch)
        return found if _is_tensor(T_base_tool) else self._as_arrays(found)

    def all_branches(
        self, T_base_tool: Any
    ) -> "pisigma.inverse.solution.Solution | pisigma.kernels.solution.CompiledSolution":
        """Solutions on every branch, as `(*batch, branches)`; one for a robot without closed-form inverse."""
        kernels = None if _is_tensor(T_base_tool) else self.compiled
        if kernels is None:
            found = self.torch.all_branches(T_base_tool)
            return found if _is_tensor(T_base_tool) else self._as_arrays(found)
        T = _as_poses(T_base_tool)
        every = kernels.all_branches(T.reshape(-1, 4, 4))
        return every.reshaped((*T.shape[:-2], len(self.branches)))._replace(owner=self)

    def path(
        self, T_base_tool: Any, *, near: Any = None, branch: str | None = None
    ) -> "pisigma.inverse.path.JointPath":
        """Find joint values along a path: one branch as long as possible, and word of every place where that ends.

        Args:
            T_base_tool: `(poses, 4, 4)` wanted poses in order [m]; as NumPy array or nested lists.
            near: `(dof,)` joint values [rad or m] where the robot is before the path.
            branch: name of the branch to begin on if that costs no jump.

        Raises:
            PoseError: see `__call__`.
        """
        from pisigma.inverse.path import follow_path

        return follow_path(self, T_base_tool, near, branch)

    def under(self, *, payload_kg: float | None = None, temperature_c: float | None = None) -> "CorrectedIK":
        """The same of the robot under other conditions than the usual ones of the calibration rows.

        Args:
            payload_kg: what it carries [kg]; as usual if None.
            temperature_c: of the robot [deg C]; as usual if None.

        Raises:
            ModelError: the model did not learn what a given condition does, or not near the given value.
        """
        from pisigma.model.stated_conditions import under_stated_conditions

        return CorrectedIK(under_stated_conditions(self.model, payload_kg, temperature_c))

    def accuracy(self, q: Any) -> Any:
        """Predicted standard deviation [m] of the tool's position at joint values `(*batch, dof)`, as an array."""
        import torch

        from pisigma.model.accuracy import position_accuracy

        return position_accuracy(self.model, torch.from_numpy(np.array(q, dtype=np.float64))).numpy()

    def to_pytorch_kinematics(self) -> "pytorch_kinematics.SerialChain":
        """The geometry as a chain of pytorch-kinematics; see `CalibratedModel.to_pytorch_kinematics`."""
        return self.model.to_pytorch_kinematics()

    @cached_property
    def postures(self) -> Postures:
        """What `near` may be."""
        return Postures(self.limits, self.revolute, self.joints)

    def _by_kernels(
        self,
        kernels: "pisigma.kernels.solver.CompiledIK",
        T_base_tool: Any,
        near: Any,
        branch: str | None,
        throw: bool,
    ) -> "pisigma.kernels.solution.CompiledSolution":
        T = T_base_tool if isinstance(T_base_tool, np.ndarray) else _as_poses(T_base_tool)
        if T.ndim == 2:
            return kernels.solve(T, near, branch, throw)._replace(owner=self)
        batch, T = T.shape[:-2], _as_poses(T)
        beside = None if near is None else self._beside(near, batch)
        found = kernels.solve_batch(T.reshape(-1, 4, 4), beside, branch, throw=throw)
        return found.reshaped(batch)._replace(owner=self)

    def _beside(self, near: Any, batch: tuple[int, ...]) -> Any:
        """Joint values for every pose of a batch, or the same for all."""
        try:
            values = np.asarray(near, dtype=np.float64)
        except (TypeError, ValueError):
            return near  # the kernels say what is wrong
        if values.ndim <= 1:
            return values
        try:
            return np.broadcast_to(values, (*batch, values.shape[-1])).reshape(-1, values.shape[-1])
        except ValueError:
            raise PoseError(
                f"near has the batch shape {values.shape[:-1]}, which does not broadcast to {batch} of the poses; give "
                "one row of joint values for each pose, or one for all."
            ) from None

    def _as_arrays(
        self, found: "pisigma.inverse.solution.Solution"
    ) -> "pisigma.kernels.solution.CompiledSolution":
        """A solution of tensors as one of arrays."""
        from pisigma.kernels.solution import CompiledSolution

        values = (found.q, found.q_nominal, found.branch, found.status)
        q, nominal, branch, status = (value.numpy(force=True) for value in values)
        residuals = (found.position_residual, found.rotation_residual, found.domain_measure)
        position, rotation, measure = (value.numpy(force=True) for value in residuals)
        return CompiledSolution(q, nominal, branch, self.branches, status, position, rotation, measure, self)


def _as_poses(values: Any) -> Any:
    """Matrices `(*batch, 4, 4)` as an array."""
    try:
        T = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise PoseError(
            "T_base_tool is no array of numbers; give homogeneous transforms of shape (*batch, 4, 4)."
        ) from None
    if T.ndim < 2 or T.shape[-2:] != (4, 4):
        raise PoseError(
            f"T_base_tool has the shape {T.shape}; give homogeneous transforms of shape (*batch, 4, 4)."
        )
    return T


def _is_tensor(values: Any) -> bool:
    """Whether values are a tensor; torch need not be imported to know."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(values, torch.Tensor)


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
    stated = kernels.belongs_to

    def read() -> "pisigma.model.calibrated_model.CalibratedModel":
        from pisigma.model.folder.model_folder import load_model

        if folder_hash(path) != stated:
            raise ModelError(f"{path}: was changed after it was loaded; load it again.")
        return load_model(path)

    return CorrectedIK._of_kernels(kernels, read)


def _stored_kernels(path: Path) -> "pisigma.kernels.solver.CompiledIK | None":
    """What stands ready in a model folder; None where that is missing, damaged or of another state of the model."""
    stated = folder_hash(path)
    if stated is None or not (path / COMPILED).is_file():
        return None
    from pisigma.kernels.solver import CompiledIK

    try:
        kernels = CompiledIK.load(path / COMPILED)
    except ModelError:
        return None
    return kernels if kernels.belongs_to == stated else None
