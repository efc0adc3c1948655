"""What a robot is: DH + Hayati rows, joints, base and tool, in SI units."""

import math
import os
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import PoseError, RobotError, nearest_choice
from pisigma.robot.coupling import Coupling
from pisigma.robot.robot_file import read_robot
from pisigma.robot.row import LARGEST, MOST_ROWS, JointType, Row
from pisigma.robot.urdf_frames import Frame, frame_of, row_frame, shift, turn

if TYPE_CHECKING:
    import pytorch_kinematics

BASE_FRAME, TOOL_FRAME = "base_link", "tool0"
"""Names of the first and the last frame of a chain of pytorch-kinematics."""


@dataclass(frozen=True, eq=False)
class Robot:
    """A serial robot: `T_base_tool(q) = base · A_1(q_1) ... A_n(q_n) · tool`.

    "base" is the frame that poses are given in; `base` maps the frame of the first row into it.

    Attributes:
        name: short name, as in the catalogue.
        maker: who builds it.
        source: where the figures come from.
        rows: joints and fixed rows, from the base to the tool.
        dh: `(rows, 5)`: theta [rad], d [m], a [m], alpha [rad], beta [rad].
        base: x, y, z [m], roll, pitch, yaw [rad] of `Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`.
        tool: the same for the tool behind the last row.
        coupling: how the joints of the rows follow the controller's values; None where these are the same. Joint values
            are DH values everywhere but in files, in answers of `CorrectedIK` and where a name or docstring says that
            they are the controller's.
        urdf: the content of the URDF file that it was drawn in, for exports; None where it was drawn otherwise.
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
        """Check that the parts fit together and make the arrays read-only."""
        robot = f"robot '{self.name}'"
        for name, shape in (("dh", (len(self.rows), 5)), ("base", (6,)), ("tool", (6,))):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != shape:
                raise RobotError(f"{robot}: {name} of shape {shape} was wanted, got {values.shape}.")
            if not (np.abs(values) <= LARGEST / 1e3).all():
                raise RobotError(
                    f"{robot}: {name} has an entry that is not finite or over {LARGEST / 1e3:.0e} m or rad; correct it."
                )
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        if self.dof == 0:
            raise RobotError(f"{robot}: it has no joint that moves; add a revolute or prismatic one.")
        names = [row.name for row in self.rows]
        if len(names) > MOST_ROWS:
            raise RobotError(f"{robot}: it has {len(names):,} rows; {MOST_ROWS:,} at most were wanted.")
        if len(set(names)) < len(names):
            twice = sorted(name for name in names if names.count(name) > 1)
            raise RobotError(f"{robot}: the row name '{twice[0]}' stands twice; names must differ.")
        types = get_args(JointType)
        for row in self.rows:
            place = f"{robot}, row '{row.name}'"
            if row.type not in types:
                hint = nearest_choice(row.type, types)
                raise RobotError(f"{place}: the type cannot be '{row.type}'; {hint}")
            if row.direction not in (1, -1):
                raise RobotError(f"{place}: direction is +1 or -1, got {row.direction}.")
            stroke = [bound for bound in (row.lower, row.upper) if math.isfinite(bound)]
            if row.type == "prismatic" and max(map(abs, stroke), default=0.0) > LARGEST / 1e3:
                raise RobotError(
                    f"{place}: a limit is above {LARGEST / 1e3:.0e} m; correct it or leave both out."
                )
            if not row.lower < row.upper:
                raise RobotError(
                    f"{place}: the lower limit {row.lower:g} is not below the upper limit {row.upper:g}; "
                    "swap or correct them."
                )

    @staticmethod
    def load(robot: str | os.PathLike[str], base: str | None = None, tip: str | None = None) -> "Robot":
        """Load a robot by catalogue name, from a YAML or from a URDF file.

        Args:
            robot: name or file.
            base: of a URDF file the link that poses are given in; its root where none is given.
            tip: of a URDF file the link that is the tool; its only end where none is given.

        Raises:
            UnknownRobotError: neither a catalogue name nor a file; the message lists the catalogue.
            RobotError: the file does not describe a robot, or links are named where there is no URDF file.
        """
        return Robot(*read_robot(robot, base, tip))

    @cached_property
    def joints(self) -> tuple[Row, ...]:
        """The rows that move, in order."""
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
        """What the controller commands, in order; the joints where they are not coupled."""
        return self.joints if self.coupling is None else self.coupling.axes

    @property
    def axis_limits(self) -> Float64[np.ndarray, "axes 2"]:
        """Lower and upper limit of every axis [rad or m]: what the controller allows."""
        return np.array([[axis.lower, axis.upper] for axis in self.axes])

    def to_dh(self, q: Any) -> Any:
        """Give the joint values `(*batch, dof)` at the controller's values `(*batch, axes)`, both [rad or m]."""
        return q if self.coupling is None else self.coupling.to_dh(q)

    def to_controller(self, q: Any) -> Any:
        """Give the controller's values `(*batch, axes)` at joint values `(*batch, dof)`, both [rad or m]."""
        return q if self.coupling is None else self.coupling.to_controller(q)

    @property
    def limits(self) -> Float64[np.ndarray, " dof 2"]:
        """Lower and upper limit of every joint [rad or m]; of a coupled one the widest that the axes allow."""
        return np.array([[joint.lower, joint.upper] for joint in self.joints])

    @property
    def directions(self) -> Float64[np.ndarray, " dof"]:
        """+1 or -1 for every joint."""
        return np.array([float(joint.direction) for joint in self.joints])

    @cached_property
    def revolute(self) -> tuple[bool, ...]:
        """For every joint, whether it turns."""
        return tuple(joint.type == "revolute" for joint in self.joints)

    @cached_property
    def reach(self) -> float:
        """A length [m] that no tool position can be farther than from the first row's origin.

        Prismatic joints count with their farthest limit, or not at all where they have none.
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
        """The same robot with other geometric parameters; what is not given stays."""
        return replace(
            self,
            dh=self.dh if dh is None else dh,
            base=self.base if base is None else base,
            tool=self.tool if tool is None else tool,
        )

    def to_pytorch_kinematics(self) -> "pytorch_kinematics.SerialChain":
        """Give the robot as a chain of pytorch-kinematics in float64; see `serial_chain`.

        `chain.forward_kinematics(q).get_matrix()` is T_base_tool at joint values q [rad or m] of shape `(*batch, dof)`
        with one batch axis.
        """
        return serial_chain(self)

    def check_joint_count(self, count: int) -> None:
        """Refuse joint values whose last axis does not fit the joints.

        Raises:
            PoseError: `count` is not the number of joints.
        """
        if count != self.dof:
            names = ", ".join(joint.name for joint in self.joints)
            raise PoseError(
                f"robot '{self.name}' has {self.dof} joints ({names}), but the joint values have {count} "
                "columns; give one per joint."
            )


def serial_chain(robot: Robot) -> "pytorch_kinematics.SerialChain":
    """Build the chain from the frame that poses are given in to the tool, in float64 on the CPU.

    A joint stands where its row has it after `RotZ(theta) · Trans(0, 0, d)` and moves about or along z, or against
    it where its direction is -1; `Trans(a, 0, 0) · RotX(alpha) · RotY(beta)` leads on to the next. Everything is made
    in float64: a chain that is made in float32 and converted is off by 2e-8 m.

    Args:
        robot: its rows are the frames of the chain, between `base_link` and `tool0`; joints are named like the rows
            and take the same joint values [rad or m].
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

    root = frames.Frame(BASE_FRAME, frames.Link(BASE_FRAME), frames.Joint("root", dtype=double))
    last, behind = root, frame_of(robot.base)
    for row, (theta, d, a, alpha, beta) in zip(robot.rows, robot.dh.tolist(), strict=True):
        last = attach(
            last,
            f"{row.name}_link",
            behind @ turn(2, theta) @ shift(0.0, 0.0, d),
            row.name,
            joint_type=row.type,
            axis=(0.0, 0.0, float(row.direction)),
            limits=(row.lower, row.upper) if np.isfinite([row.lower, row.upper]).all() else None,
        )
        behind = row_frame(0.0, 0.0, a, alpha, beta)
    attach(last, TOOL_FRAME, behind @ frame_of(robot.tool), "tool")
    return SerialChain(Chain(root, dtype=double), TOOL_FRAME, dtype=double)
