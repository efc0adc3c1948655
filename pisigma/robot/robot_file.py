"""Read robots from the catalogue, YAML files (mm and deg) and URDF files."""

import os
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field, model_validator

from pisigma.files.errors import RobotError, UnknownRobotError, choice_remedy
from pisigma.files.yaml_file import Section, parse_yaml, read_yaml
from pisigma.robot.coupling_section import CoupledJointSection, rows_and_coupling
from pisigma.robot.robot_fields import RobotFields
from pisigma.robot.row import MAX_ROWS, BoundedFloat, JointType, Row
from pisigma.robot.urdf_frames import frame_of, rotation, translation, xyz_zyx_of

Limits = Annotated[tuple[BoundedFloat, BoundedFloat], Field(description="lower and upper")]


class ParameterSection(Section):
    """Section of a robot file with the DH and Hayati parameters of a row.

    Attributes:
        theta_deg: rotation about the joint axis z at joint value 0 [deg].
        d_mm: translation along z [mm].
        a_mm: translation along x [mm].
        alpha_deg: rotation about x [deg].
        beta_deg: rotation about y, for nearly parallel axes [deg].
    """

    theta_deg: BoundedFloat = 0.0
    d_mm: BoundedFloat = 0.0
    a_mm: BoundedFloat = 0.0
    alpha_deg: BoundedFloat = 0.0
    beta_deg: BoundedFloat = 0.0

    def to_si(self) -> Float64[np.ndarray, " 5"]:
        """Return the parameters in the order of `DH_COLUMNS` [rad or m]."""
        theta, alpha, beta = np.deg2rad([self.theta_deg, self.alpha_deg, self.beta_deg])
        return np.array([theta, self.d_mm / 1e3, self.a_mm / 1e3, alpha, beta])


class RowSection(ParameterSection):
    """Section of a robot file with a joint or a fixed row."""

    name: str = Field(min_length=1)
    type: JointType
    direction: Literal[1, -1] = 1
    limits_deg: Limits | None = None
    limits_mm: Limits | None = None
    drawn_at_mm: tuple[BoundedFloat, BoundedFloat, BoundedFloat] = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _limits_fit_type(self) -> "RowSection":
        wrong = {
            "revolute": "limits_mm" if self.limits_mm else None,
            "prismatic": "limits_deg" if self.limits_deg else None,
            "fixed": "limits_deg" if self.limits_deg else "limits_mm" if self.limits_mm else None,
        }[self.type]
        if wrong:
            problem = f"row '{self.name}' is {self.type} and cannot have {wrong}"
            raise RobotError(problem, value=wrong, remedy="remove it")
        limits = self.limits_deg or self.limits_mm
        if limits and not limits[0] < limits[1]:
            raise RobotError(
                f"row '{self.name}': the lower limit {limits[0]:g} is not below the upper limit {limits[1]:g}",
                expected="a lower limit below the upper limit",
                value=limits,
                remedy="swap or correct the limits",
            )
        return self

    def to_row(self) -> Row:
        """Return the row in SI units, without the DH parameters."""
        if self.limits_deg is not None:
            lower, upper = np.deg2rad(self.limits_deg)
        elif self.limits_mm is not None:
            lower, upper = np.array(self.limits_mm) / 1e3
        else:
            lower, upper = -np.inf, np.inf
        x, y, z = self.drawn_at_mm
        urdf_origin = x / 1e3, y / 1e3, z / 1e3
        return Row(self.name, self.type, self.direction, float(lower), float(upper), urdf_origin)


class FrameSection(Section):
    """Section of a robot file with base or tool: `Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`.

    Attributes:
        x_mm: translation along x [mm].
        y_mm: translation along y [mm].
        z_mm: translation along z [mm].
        roll_deg: rotation about z [deg].
        pitch_deg: rotation about y [deg].
        yaw_deg: rotation about x [deg].
    """

    x_mm: BoundedFloat = 0.0
    y_mm: BoundedFloat = 0.0
    z_mm: BoundedFloat = 0.0
    roll_deg: BoundedFloat = 0.0
    pitch_deg: BoundedFloat = 0.0
    yaw_deg: BoundedFloat = 0.0

    def to_si(self) -> np.ndarray:
        """Return x, y, z [m], roll, pitch, yaw [rad]."""
        lengths = np.array([self.x_mm, self.y_mm, self.z_mm]) / 1e3
        return np.concatenate([lengths, np.deg2rad([self.roll_deg, self.pitch_deg, self.yaw_deg])])


class RobotDocument(Section):
    """Contents of a robot file.

    Attributes:
        convention: "standard" for rows `RotZ(theta) · Trans(a, 0, d) · RotX(alpha) · RotY(beta)`; "modified" for rows
            `RotX(alpha) · Trans(a, 0, 0) · RotZ(theta) · Trans(0, 0, d)` (Craig 1986).
        coupling: joints whose values differ from the controller's values of the same names.
    """

    name: str = Field(min_length=1)
    maker: str
    source: str
    convention: Literal["standard", "modified"] = "standard"
    rows: tuple[RowSection, ...] = Field(min_length=1, max_length=MAX_ROWS)
    base: FrameSection = FrameSection()
    tool: FrameSection = FrameSection()
    coupling: tuple[CoupledJointSection, ...] = ()

    @model_validator(mode="after")
    def _rows_fit_together(self) -> "RobotDocument":
        names = [row.name for row in self.rows]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            problem = f"the row name '{twice[0]}' appears twice"
            raise RobotError(problem, value=twice[0], remedy="use different names")
        if all(row.type == "fixed" for row in self.rows):
            remedy = "add a revolute or prismatic joint"
            raise RobotError("the robot has no joint", expected="a joint", remedy=remedy)
        self.to_fields()
        return self

    def to_fields(self) -> RobotFields:
        """Return the fields of the robot in SI units.

        Raises:
            RobotError: the coupling does not fit the rows, or a row in the modified convention has a beta.
        """
        rows, coupling = rows_and_coupling([row.to_row() for row in self.rows], self.coupling)
        dh, base = np.array([row.to_si() for row in self.rows]), self.base.to_si()
        if self.convention == "modified":
            dh, base = from_modified_dh(dh, base)
        return RobotFields(self.name, self.maker, self.source, rows, dh, base, self.tool.to_si(), coupling)


def catalogue() -> tuple[str, ...]:
    """Return the sorted names of the robots that are included in pisigma."""
    folder = resources.files("pisigma.robot") / "catalogue"
    names = (entry.name for entry in folder.iterdir())
    return tuple(sorted(name.removesuffix(".yaml") for name in names if name.endswith(".yaml")))


def robot_file(robot: str) -> Path | None:
    """Return the file that `Robot.load` reads; None for a robot of the catalogue."""
    return None if robot in catalogue() else Path(robot)


def read_robot(robot: str | os.PathLike[str], base: str | None, tip: str | None) -> RobotFields:
    """Read a robot by catalogue name, or from a YAML or URDF file; see `Robot.load`."""
    name = os.fspath(robot)
    suffix = Path(name).suffix.lower()
    if suffix in (".urdf", ".xacro") and name not in catalogue():
        from pisigma.robot.urdf_chain import read_chain
        from pisigma.robot.urdf_rows import rows_of_chain

        return rows_of_chain(read_chain(name, base, tip)).fields
    for option, link in (("base", base), ("tip", tip)):
        if link is not None:
            raise RobotError(
                f"'{link}' is a link of a URDF file, but '{name}' is not a URDF file",
                value=link,
                option=option,
                remedy="omit it or give a .urdf file",
            )
    if name in catalogue():
        text = (resources.files("pisigma.robot") / "catalogue" / f"{name}.yaml").read_text(encoding="utf-8")
        return parse_yaml(text, RobotDocument, RobotError, source=f"catalogue/{name}.yaml").to_fields()
    if suffix in (".yaml", ".yml"):
        return read_yaml(name, RobotDocument, RobotError).to_fields()
    raise UnknownRobotError(
        f"'{name}' is neither a robot of the catalogue nor a .yaml or .urdf file",
        value=name,
        remedy=choice_remedy(name, catalogue()),
    )


def from_modified_dh(
    dh: Float64[np.ndarray, "rows 5"], base: Float64[np.ndarray, " 6"]
) -> tuple[Float64[np.ndarray, "rows 5"], Float64[np.ndarray, " 6"]]:
    """Convert modified rows `RotX(alpha) · Trans(a, 0, 0) · RotZ(theta) · Trans(0, 0, d)` to standard rows exactly.

    Alpha and a of a modified row become part of the preceding standard row, or of the base for the first row.

    Args:
        dh: theta [rad], d, a [m], alpha, beta [rad] of modified rows.
        base: x, y, z [m], roll, pitch, yaw [rad].

    Returns:
        Standard rows and their base; the tool is unchanged.

    Raises:
        RobotError: a row has a beta, which the modified convention does not have.
    """
    if dh[:, 4].any():
        row = int(dh[:, 4].nonzero()[0][0])
        raise RobotError(
            f"row {row + 1}: the modified convention has no beta_deg",
            value=float(np.rad2deg(dh[row, 4])),
            remedy="omit it or use the standard convention",
        )
    standard = dh.copy()
    standard[:, 2:4] = np.roll(dh[:, 2:4], -1, axis=0)
    standard[-1, 2:4] = 0.0
    if dh[0, 2:4].any():
        base = xyz_zyx_of(frame_of(base) @ rotation(0, dh[0, 3]) @ translation(dh[0, 2], 0.0, 0.0))
    return standard, base
