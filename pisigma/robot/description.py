"""Robot description: DH and Hayati rows, joints, base and tool, in SI units."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import PoseError, RobotError, choice_remedy
from pisigma.robot.coupling import Coupling
from pisigma.robot.robot_file import read_robot
from pisigma.robot.row import MAX_MAGNITUDE, MAX_ROWS, JointType, Row
from pisigma.robot.urdf_frames import Frame, frame_of, rotation, row_frame, translation

if TYPE_CHECKING:
    import pytorch_kinematics

_BASE_FRAME, _TOOL_FRAME = "base_link", "tool0"
"""Names of the first and last frame of a pytorch-kinematics chain."""


@dataclass(frozen=True, eq=False)
class Robot:
    """A serial robot: `T_base_tool(q) = base · A_1(q_1) ... A_n(q_n) · tool`.

    Poses are given in the frame "base"; `base` is the pose of the first row's frame in it.

    Attributes:
        name: short name, as in the catalogue.
        maker: manufacturer.
        source: source of the parameter values, such as a data sheet.
        rows: joints and fixed rows, from the base to the tool.
        dh: `(rows, 5)`: theta [rad], d [m], a [m], alpha [rad], beta [rad].
        base: x, y, z [m], roll, pitch, yaw [rad] of `Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`.
        tool: pose of the tool in the frame after the last row, in the same form as `base`.
        coupling: relation between the joint values of the rows (DH values) and the controller's values; None if they
            are equal. Joint values are DH values everywhere except in files, in results of `CorrectedIK`, and where a
            name or docstring states that they are the controller's.
        urdf: content of the URDF file that describes the robot, for exports; None if it was not read from one.
    """

    name: str
    maker: str
    source: str
    rows: tuple[Row, ...]
    dh: Float64[np.ndarray, " rows 5"]
    base: Float64[np.ndarray, " 6"] = field(default_factory=lambda: np.zeros(6))
    tool: Float64[np.ndarray, " 6"] = field(default_factory=lambda: np.zeros(6))
    coupling: Coupling | None = None
    urdf: bytes | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Check that the attributes are consistent, and make the arrays read-only."""
        robot = f"robot '{self.name}'"
        for name, shape in (("dh", (len(self.rows), 5)), ("base", (6,)), ("tool", (6,))):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != shape:
                raise RobotError(
                    f"{robot}: expected {name} of shape {shape}, got {values.shape}",
                    expected=f"shape {shape}",
                    value=values.shape,
                )
            if not (np.abs(values) <= MAX_MAGNITUDE / 1e3).all():
                raise RobotError(
                    f"{robot}: {name} has an entry that is not finite or exceeds {MAX_MAGNITUDE / 1e3:.0e} m or rad",
                    expected=f"finite values up to {MAX_MAGNITUDE / 1e3:.0e} m or rad",
                    remedy="correct the entry",
                )
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        if self.dof == 0:
            remedy = "add a revolute or prismatic joint"
            raise RobotError(f"{robot} has no joint", expected="a joint", remedy=remedy)
        names = [row.name for row in self.rows]
        if len(names) > MAX_ROWS:
            expected = f"at most {MAX_ROWS:,} rows"
            problem = f"{robot}: expected {expected}, got {len(names):,}"
            raise RobotError(problem, expected=expected, value=len(names))
        if len(set(names)) < len(names):
            twice = sorted(name for name in names if names.count(name) > 1)[0]
            problem, remedy = f"{robot}: the row name '{twice}' appears twice", "use different names"
            raise RobotError(problem, value=twice, remedy=remedy)
        for row in self.rows:
            _check_row(row, f"{robot}, row '{row.name}'")

    @staticmethod
    def load(robot: str | os.PathLike[str], base: str | None = None, tip: str | None = None) -> "Robot":
        """Load a robot by catalogue name, or from a YAML or URDF file.

        Args:
            robot: catalogue name or path of a file.
            base: base link of a URDF file; poses are in its frame. None for the root link.
            tip: tool link of a URDF file; None if only one link has no child.

        Raises:
            UnknownRobotError: `robot` is neither a catalogue name nor a file; the message lists the names in the
                catalogue.
            RobotError: the file does not describe a robot, or links are given for a file that is not URDF.
        """
        return Robot(*read_robot(robot, base, tip))

    @cached_property
    def joints(self) -> tuple[Row, ...]:
        """Rows of the joints that move, from base to tool."""
        return tuple(row for row in self.rows if row.type != "fixed")

    @property
    def dof(self) -> int:
        """Number of joints that move."""
        return len(self.joints)

    @cached_property
    def joint_rows(self) -> tuple[int, ...]:
        """Index of the row of every joint."""
        return tuple(i for i, row in enumerate(self.rows) if row.type != "fixed")

    @property
    def axes(self) -> tuple[Row, ...]:
        """Axes that the controller commands, from base to tool; the joints if they are not coupled."""
        return self.joints if self.coupling is None else self.coupling.axes

    @property
    def axis_limits(self) -> Float64[np.ndarray, "axes 2"]:
        """Lower and upper limit of every axis of the controller [rad or m]."""
        return np.array([[axis.lower, axis.upper] for axis in self.axes])

    def to_dh(self, q: Any) -> Any:
        """Convert the controller's values `(*batch, axes)` to joint values `(*batch, dof)`, both [rad or m]."""
        return q if self.coupling is None else self.coupling.to_dh(q)

    def to_controller(self, q: Any) -> Any:
        """Convert joint values `(*batch, dof)` to the controller's values `(*batch, axes)`, both [rad or m]."""
        return q if self.coupling is None else self.coupling.to_controller(q)

    def in_file_units(self, q: Any) -> Float64[np.ndarray, "*batch axes"]:
        """Convert joint values `(*batch, dof)` [rad or m] to the controller's values of `axes` [deg or mm]."""
        per_si = [math.degrees(1.0) if axis.type == "revolute" else 1e3 for axis in self.axes]
        return np.asarray(self.to_controller(np.asarray(q, dtype=np.float64))) * per_si

    @property
    def limits(self) -> Float64[np.ndarray, " dof 2"]:
        """Lower and upper limit of every joint [rad or m]; for a coupled joint, the range that the axes allow."""
        return np.array([[joint.lower, joint.upper] for joint in self.joints])

    @property
    def without_limits(self) -> "Robot":
        """The robot without joint limits, for joint values that may be swapped or in the wrong unit."""

        def without_limits(rows: Sequence[Row]) -> tuple[Row, ...]:
            return tuple(replace(row, lower=-np.inf, upper=np.inf) for row in rows)

        coupling = self.coupling and replace(self.coupling, axes=without_limits(self.coupling.axes))
        return replace(self, rows=without_limits(self.rows), coupling=coupling)

    @property
    def directions(self) -> Float64[np.ndarray, " dof"]:
        """Sign of the controller's value of every joint, +1 or -1."""
        return np.array([float(joint.direction) for joint in self.joints])

    @cached_property
    def revolute(self) -> tuple[bool, ...]:
        """Mask of the revolute joints."""
        return tuple(joint.type == "revolute" for joint in self.joints)

    @cached_property
    def reach(self) -> float:
        """Upper bound on the distance of the tool from the origin of the first row [m].

        Prismatic joints contribute their larger limit, or nothing if they have no limits.
        """
        strokes = sum(
            max(abs(bound) for bound in (joint.lower, joint.upper) if np.isfinite(bound))
            for joint in self.joints
            if joint.type == "prismatic" and np.isfinite([joint.lower, joint.upper]).any()
        )
        links = float(np.hypot(self.dh[:, 1], self.dh[:, 2]).sum())
        return links + float(np.linalg.norm(self.tool[:3])) + float(strokes)

    def with_geometry(
        self,
        dh: Float64[np.ndarray, " rows 5"] | None = None,
        base: Float64[np.ndarray, " 6"] | None = None,
        tool: Float64[np.ndarray, " 6"] | None = None,
    ) -> "Robot":
        """Return the robot with other geometric parameters; None keeps the current values."""
        return replace(
            self,
            dh=self.dh if dh is None else dh,
            base=self.base if base is None else base,
            tool=self.tool if tool is None else tool,
        )

    def to_pytorch_kinematics(self) -> "pytorch_kinematics.SerialChain":
        """Convert the robot to a float64 chain of pytorch-kinematics; see `serial_chain`.

        `chain.forward_kinematics(q).get_matrix()` is T_base_tool at joint values q [rad or m] of shape `(batch, dof)`.
        """
        return serial_chain(self)

    def check_joint_count(self, count: int) -> None:
        """Check that joint values have one column per joint.

        Raises:
            PoseError: `count` is not the number of joints.
        """
        if count != self.dof:
            names = ", ".join(joint.name for joint in self.joints)
            raise PoseError(
                f"robot '{self.name}' has {self.dof} joints ({names}), but the joint values have {count} columns",
                expected=f"{self.dof} columns",
                value=count,
                remedy="give one per joint",
            )


def _check_row(row: Row, place: str) -> None:
    """Check the type, direction and limits of a row; `place` precedes the message."""
    types = get_args(JointType)
    if row.type not in types:
        hint = choice_remedy(row.type, types)
        raise RobotError(f"{place}: unknown joint type '{row.type}'", value=row.type, remedy=hint)
    if row.direction not in (1, -1):
        problem = f"{place}: expected the direction +1 or -1, got {row.direction}"
        raise RobotError(problem, expected="+1 or -1", value=row.direction)
    bounds = row.lower, row.upper
    stroke = max((abs(bound) for bound in bounds if math.isfinite(bound)), default=0.0)
    if row.type == "prismatic" and stroke > MAX_MAGNITUDE / 1e3:
        expected = f"limits up to {MAX_MAGNITUDE / 1e3:.0e} m"
        problem, remedy = f"{place}: expected {expected}, got {stroke:g} m", "correct the limits or omit both"
        raise RobotError(problem, expected=expected, value=stroke, remedy=remedy)
    if not row.lower < row.upper:
        problem = f"{place}: the lower limit {row.lower:g} is not below the upper limit {row.upper:g}"
        expected, remedy = "a lower limit below the upper limit", "swap or correct the limits"
        raise RobotError(problem, expected=expected, value=bounds, remedy=remedy)


def serial_chain(robot: Robot) -> "pytorch_kinematics.SerialChain":
    """Build a pytorch-kinematics chain from the base frame to the tool, in float64 on the CPU.

    The frame of a joint is that of its row after `RotZ(theta) · Trans(0, 0, d)`. The joint moves about or along z, in
    the opposite sense if its direction is -1; `Trans(a, 0, 0) · RotX(alpha) · RotY(beta)` leads to the next joint.
    Everything is computed in float64, because a chain that is built in float32 and converted is off by 2e-8 m.

    Args:
        robot: the robot; its rows are the frames of the chain, between `base_link` and `tool0`, and joints have the
            names and joint values [rad or m] of the rows.
    """
    import torch
    from pytorch_kinematics import SerialChain, Transform3d
    from pytorch_kinematics import frame as frames
    from pytorch_kinematics.chain import Chain

    double = torch.float64

    def attach(parent: frames.Frame, name: str, origin: Frame, joint: str, **motion: object) -> frames.Frame:
        offset = Transform3d(matrix=torch.from_numpy(origin)[None], dtype=double)
        child = frames.Frame(name, frames.Link(name), frames.Joint(joint, offset, dtype=double, **motion))
        parent.add_child(child)
        return child

    root = frames.Frame(_BASE_FRAME, frames.Link(_BASE_FRAME), frames.Joint("root", dtype=double))
    last, behind = root, frame_of(robot.base)
    for row, (theta, d, a, alpha, beta) in zip(robot.rows, robot.dh.tolist(), strict=True):
        last = attach(
            last,
            f"{row.name}_link",
            behind @ rotation(2, theta) @ translation(0.0, 0.0, d),
            row.name,
            joint_type=row.type,
            axis=(0.0, 0.0, float(row.direction)),
            limits=(row.lower, row.upper) if np.isfinite([row.lower, row.upper]).all() else None,
        )
        behind = row_frame(0.0, 0.0, a, alpha, beta)
    attach(last, _TOOL_FRAME, behind @ frame_of(robot.tool), "tool")
    return SerialChain(Chain(root, dtype=double), _TOOL_FRAME, dtype=double)
