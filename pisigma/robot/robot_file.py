"""A robot as a YAML file: millimetres and degrees outside, SI inside."""

from typing import Annotated, Literal

import numpy as np
import yaml
from pydantic import Field, model_validator

from pisigma.errors import RobotError
from pisigma.robot.description import DH_COLUMNS, FRAME_COLUMNS, JointType, Robot, Row
from pisigma.yaml_file import Section

Limits = Annotated[tuple[float, float], Field(description="lower and upper")]


class RowSection(Section):
    """One joint or fixed row. Angles in degrees, lengths in millimetres."""

    name: str = Field(min_length=1)
    type: JointType
    direction: Literal[1, -1] = 1
    limits_deg: Limits | None = None
    limits_mm: Limits | None = None
    theta_deg: float = 0.0
    d_mm: float = 0.0
    a_mm: float = 0.0
    alpha_deg: float = 0.0
    beta_deg: float = 0.0

    @model_validator(mode="after")
    def _limits_fit_type(self) -> "RowSection":
        wrong = {
            "revolute": "limits_mm" if self.limits_mm else None,
            "prismatic": "limits_deg" if self.limits_deg else None,
            "fixed": "limits_deg" if self.limits_deg else "limits_mm" if self.limits_mm else None,
        }[self.type]
        if wrong:
            raise ValueError(f"row '{self.name}' is {self.type} and cannot have {wrong}; remove it")
        limits = self.limits_deg or self.limits_mm
        if limits and not limits[0] < limits[1]:
            raise ValueError(
                f"the lower limit {limits[0]:g} of row '{self.name}' is not below its upper limit "
                f"{limits[1]:g}; swap or correct them"
            )
        return self

    def to_row(self) -> Row:
        """The row without its parameters, in SI."""
        if self.limits_deg is not None:
            lower, upper = np.deg2rad(self.limits_deg)
        elif self.limits_mm is not None:
            lower, upper = np.array(self.limits_mm) / 1e3
        else:
            lower, upper = -np.inf, np.inf
        return Row(self.name, self.type, self.direction, float(lower), float(upper))


class FrameSection(Section):
    """Base or tool: `Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`."""

    x_mm: float = 0.0
    y_mm: float = 0.0
    z_mm: float = 0.0
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0

    def to_si(self) -> np.ndarray:
        """x, y, z [m], roll, pitch, yaw [rad]."""
        lengths = np.array([self.x_mm, self.y_mm, self.z_mm]) / 1e3
        return np.concatenate([lengths, np.deg2rad([self.roll_deg, self.pitch_deg, self.yaw_deg])])


class RobotDocument(Section):
    """The whole file."""

    name: str = Field(min_length=1)
    maker: str
    source: str
    rows: tuple[RowSection, ...] = Field(min_length=1)
    base: FrameSection = FrameSection()
    tool: FrameSection = FrameSection()

    @model_validator(mode="after")
    def _rows_fit_together(self) -> "RobotDocument":
        names = [row.name for row in self.rows]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"the row name '{twice[0]}' stands twice in rows; names must differ")
        if all(row.type == "fixed" for row in self.rows):
            raise ValueError("no row moves; add a revolute or prismatic one")
        return self

    def to_robot(self) -> Robot:
        """The robot in SI units.

        Raises:
            RobotError: the parts do not fit together.
        """
        dh = [
            [
                np.deg2rad(row.theta_deg),
                row.d_mm / 1e3,
                row.a_mm / 1e3,
                np.deg2rad(row.alpha_deg),
                np.deg2rad(row.beta_deg),
            ]
            for row in self.rows
        ]
        return Robot(
            name=self.name,
            maker=self.maker,
            source=self.source,
            rows=tuple(row.to_row() for row in self.rows),
            dh=np.array(dh, dtype=np.float64),
            base=self.base.to_si(),
            tool=self.tool.to_si(),
        )


def robot_to_yaml(robot: Robot) -> str:
    """The robot as YAML text that `RobotDocument` reads back, equal to within the rounding of the units.

    Raises:
        RobotError: a row has one limit only, which a file cannot hold.
    """
    rows = []
    for row, parameters in zip(robot.rows, robot.dh, strict=True):
        entry: dict[str, object] = {"name": row.name, "type": row.type, "direction": row.direction}
        entry |= _limits_entry(row)
        for name, value in zip(DH_COLUMNS, parameters, strict=True):
            entry |= _in_file_units(name, float(value), length=name in ("d", "a"))
        rows.append(entry)
    document: dict[str, object] = {
        "name": robot.name,
        "maker": robot.maker,
        "source": robot.source,
        "rows": rows,
    }
    for frame in ("base", "tool"):
        values = getattr(robot, frame)
        section: dict[str, float] = {}
        for name, value in zip(FRAME_COLUMNS, values, strict=True):
            section |= _in_file_units(name, float(value), length=name in ("x", "y", "z"))
        document[frame] = section
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True)


def _limits_entry(row: Row) -> dict[str, list[float]]:
    bounded = np.isfinite([row.lower, row.upper])
    if not bounded.any():
        return {}
    if not bounded.all():
        raise RobotError(f"row '{row.name}' has one limit only; a robot file holds both or none.")
    if row.type == "revolute":
        return {"limits_deg": [float(np.rad2deg(row.lower)), float(np.rad2deg(row.upper))]}
    return {"limits_mm": [row.lower * 1e3, row.upper * 1e3]}


def _in_file_units(name: str, value: float, length: bool) -> dict[str, float]:
    return {f"{name}_mm": value * 1e3} if length else {f"{name}_deg": float(np.rad2deg(value))}
