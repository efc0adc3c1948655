"""Forward kinematics and joint Jacobians: compiled kernels for arrays, without torch, and torch for tensors."""

import functools
import math
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from pisigma.files.errors import ModelError
from pisigma.robot.kernels.arrays import FIXED, FORWARD, PRISMATIC, REVOLUTE
from pisigma.robot.kernels.layout import DESCRIPTION, DOF, ROWS, make_memory
from pisigma.robot.right_angles import cosine_sine

if TYPE_CHECKING:  # run-time type checkers find the full names without these imports
    import pisigma.robot.description

KINDS = {"fixed": FIXED, "revolute": REVOLUTE, "prismatic": PRISMATIC}


def forward_kinematics(robot: "pisigma.robot.description.Robot", q: Any) -> Any:
    """Compute the tool pose of a robot: `base · Π RotZ(theta + q) Trans(a, 0, d) RotX(alpha) RotY(beta) · tool`.

    Arrays and nested lists use compiled kernels on one thread: a few microseconds for a single pose, 0.1 microseconds
    per pose of a batch. Tensors use torch on their device, with gradients; see `kinematics.forward`.

    Args:
        robot: the robot.
        q: the controller's values `(*batch, axes)` [rad or m]; the joint values if joints are not coupled.

    Returns:
        T_base_tool `(*batch, 4, 4)` [m]: a float64 array for an array, a tensor for a tensor.

    Raises:
        PoseError: the number of columns of q is not the number of joints.
    """
    if robot.coupling is not None:
        q = robot.to_dh(q if is_tensor(q) else np.asarray(q, dtype=np.float64))
    chain = _chain(robot, q)
    if chain is not None:
        return chain.move(q, False)[0]
    from pisigma.robot.kinematics.forward import forward_kinematics as of_tensors

    return call_with_tensors(functools.partial(of_tensors, robot), q)


def joint_jacobian(robot: "pisigma.robot.description.Robot", q: Any) -> Any:
    """Compute the geometric Jacobian of a robot's tool pose, in the base frame and at the tool's origin.

    `J @ dq` is the translation [m] and the rotation vector [rad] of the tool (Siciliano et al. 2009, eq. 3.30). Arrays
    and tensors are treated as in `forward_kinematics`.

    Args:
        robot: the robot.
        q: the controller's values `(*batch, axes)` [rad or m]; the joint values if joints are not coupled.

    Returns:
        J `(*batch, 6, axes)`: a float64 array for an array, a tensor for a tensor.

    Raises:
        PoseError: the number of columns of q is not the number of joints.
    """
    if robot.coupling is not None:
        values = robot.to_dh(q) if is_tensor(q) else robot.to_dh(np.asarray(q, dtype=np.float64))
        slope = robot.coupling.derivative(q)
        return joint_jacobian(replace(robot, coupling=None), values) @ (
            q.new_tensor(slope) if is_tensor(q) else slope
        )
    chain = _chain(robot, q)
    if chain is not None:
        return chain.move(q, True)[1]
    from pisigma.robot.kinematics.jacobian import joint_jacobian as of_tensors

    return call_with_tensors(lambda values: of_tensors(robot, values)[1], q)


def is_tensor(values: Any) -> bool:
    """Return whether values are a tensor, without importing torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(values, torch.Tensor)


def call_with_tensors(function: Callable[[Any], Any], q: Any) -> Any:
    """Call a function of tensors; arrays are converted to float64 tensors and back."""
    import torch

    if is_tensor(q):
        return function(q)
    return function(torch.from_numpy(np.array(q, dtype=np.float64))).numpy()


def call_model(function: Callable[[Any], Any], q: Any) -> Any:
    """Call a function of a model, which lies on the CPU in float64; tensors keep their dtype, device and gradients."""
    if not is_tensor(q):
        return call_with_tensors(function, q)
    import torch

    return function(q.to("cpu", torch.float64)).to(q)


class _Chain:
    """A robot packed for the kernels; several threads may use it."""

    def __init__(self, robot: "pisigma.robot.description.Robot") -> None:
        """Pack a robot into the structs of the kernels.

        Raises:
            ModelError: the robot is larger than the kernels allow, or there are no kernels for this machine.
        """
        from pisigma.robot.kernels.machine_code import (  # imported here, because LLVM takes 40 MB that fits need
            IGNORED,
            load_kernels,
        )

        if len(robot.rows) > ROWS or robot.dof > DOF:
            expected = f"at most {DOF} joints and {ROWS} rows"
            problem = f"robot '{robot.name}' is larger than the kernels allow ({DOF} joints, {ROWS} rows)"
            raise ModelError(problem, expected=expected, value=(robot.dof, len(robot.rows)))
        self._packed = np.zeros(1, DESCRIPTION)
        arms, rows = self._packed["arms"], len(robot.rows)
        arms["dof"], arms["rows_used"] = robot.dof, rows
        arms["kind"][0, :rows] = [KINDS[row.type] for row in robot.rows]
        arms["rows"][0, 0, :rows] = arm_rows(robot)
        arms["ends"][0, 0] = base_and_tool_matrices(robot)
        arms["direction"][0, : robot.dof] = robot.directions
        arms["revolute"][0, : robot.dof] = robot.revolute
        self._dof, self._check = robot.dof, robot.check_joint_count
        self._address, self._memory = address_of(self._packed), threading.local()
        self._run = functools.partial(load_kernels(), IGNORED, IGNORED, self._address)

    def move(self, q: Any, with_jacobian: bool) -> tuple[Any, Any]:
        """Compute poses `(*batch, 4, 4)` [m], and optionally Jacobians `(*batch, 6, dof)`."""
        values = np.ascontiguousarray(q, dtype=np.float64) if np.ndim(q) else np.zeros(0)
        batch, dof = values.shape[:-1], self._dof
        if values.shape[-1] != dof:
            self._check(values.shape[-1])
        T, J = np.empty((*batch, 4, 4)), np.empty((*batch, 6, dof) if with_jacobian else 0)
        try:
            memory = self._memory.address
        except AttributeError:
            self._memory.kept = make_memory()
            memory = self._memory.address = address_of(self._memory.kept)
        at, poses, rows = address_of(values), address_of(T), math.prod(batch)
        jacobians = address_of(J) if with_jacobian else 0
        self._run(
            memory,
            FORWARD,
            rows,
            poses,
            at,
            rows,
            0,
            0,
            0,
            0,
            0,
            0,
            0,
            jacobians,
            with_jacobian,
        )
        return T, J


_chains: "WeakKeyDictionary[pisigma.robot.description.Robot, _Chain | None]" = WeakKeyDictionary()


def _chain(robot: "pisigma.robot.description.Robot", q: Any) -> _Chain | None:
    """Return the robot packed for the kernels; None for tensors, and if there are no kernels."""
    if is_tensor(q):
        return None
    try:
        return _chains[robot]
    except KeyError:
        with suppress(ModelError):
            return _chains.setdefault(robot, _Chain(robot))
        return _chains.setdefault(robot, None)


def arm_rows(robot: "pisigma.robot.description.Robot") -> np.ndarray:
    """Return the rows of an arm, `(rows, 9)`: theta [rad], d, a [m], cosine and sine of alpha, beta and theta."""
    return np.array(
        [
            (theta, d, a, *cosine_sine(alpha), *cosine_sine(beta), *cosine_sine(theta))
            for theta, d, a, alpha, beta in robot.dh.tolist()
        ]
    )


def base_and_tool_matrices(robot: "pisigma.robot.description.Robot") -> np.ndarray:
    """Return base and tool of an arm as transforms without their last rows, `(2, 3, 4)`."""
    return np.stack([transform_of(end)[:3] for end in (robot.base.tolist(), robot.tool.tolist())])


def transform_of(xyz_zyx: Any) -> np.ndarray:
    """Return `Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`, `(4, 4)`, of lengths [m] and angles [rad]."""
    return np.array(transform_entries(*xyz_zyx)).reshape(4, 4)


def transform_entries(
    x: float, y: float, z: float, roll: float, pitch: float, yaw: float
) -> tuple[float, ...]:
    """Return the 16 entries of `transform_of`, row-major."""
    (c, s), (c_p, s_p), (c_y, s_y) = cosine_sine(roll), cosine_sine(pitch), cosine_sine(yaw)
    first = c * c_p, c * s_p * s_y - s * c_y, c * s_p * c_y + s * s_y, x
    second = s * c_p, s * s_p * s_y + c * c_y, s * s_p * c_y - c * s_y, y
    return (*first, *second, -s_p, c_p * s_y, c_p * c_y, z, 0.0, 0.0, 0.0, 1.0)


def xyz_zyx_of(T: Any) -> tuple[float, ...]:
    """Return x, y, z [m], roll, pitch and yaw [rad] of a transform `(4, 4)`: the inverse of `transform_of`.

    The pitch is within ±90 deg; at ±90 deg yaw is set to 0.
    """
    rows = np.asarray(T).tolist()
    (a, b, _, x), (c, d, _, y), (e, f, g, z), _ = rows
    horizontal = math.hypot(a, c)
    pitch = math.atan2(-e, horizontal)
    if horizontal > 1e-12:
        return x, y, z, math.atan2(c, a), pitch, math.atan2(f, g)
    return x, y, z, math.atan2(-b, d), pitch, 0.0


def address_of(array: Any) -> int:
    """Return the memory address of a contiguous array."""
    return array.__array_interface__["data"][0]
