"""Surroundings of a robot that is measured: joint margins, floor, boxes, tracker and camera."""

import os
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float64
from pydantic import Field, model_validator
from torch import Tensor

from pisigma.files.errors import PlanningError, RecipeError, choice_remedy
from pisigma.files.yaml_file import Section, place_of_key, read_yaml
from pisigma.planning.surroundings.capsules import TOOL_RADIUS, Capsules
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import FrameSection, Limits
from pisigma.robot.row import BoundedFloat
from pisigma.robot.se3 import rotation_from_zyx, transform_from_xyz_zyx, xyz_zyx_from_transform
from pisigma.simulation.errors.source import values_by_joint_index

Positive = Annotated[BoundedFloat, Field(gt=0)]
NotNegative = Annotated[BoundedFloat, Field(ge=0)]
Point = tuple[BoundedFloat, BoundedFloat, BoundedFloat]


class JointSection(Section):
    """Joint limits in these surroundings.

    Attributes:
        margin_deg: margin of revolute joints to their limits [deg].
        margin_mm: margin of prismatic joints to their limits [mm].
        limits_deg: narrower limits of revolute joints by name [deg].
        limits_mm: narrower limits of prismatic joints by name [mm].
    """

    margin_deg: NotNegative = 0.0
    margin_mm: NotNegative = 0.0
    limits_deg: dict[str, Limits] = Field(default_factory=dict)
    limits_mm: dict[str, Limits] = Field(default_factory=dict)

    def limits(self, robot: Robot) -> Float64[Tensor, "axes 2"]:
        """Return the allowed range of the controller's values [rad or m]; infinite if there is no limit.

        Raises:
            RecipeError: a name is not a joint of the robot, or is a joint of the other kind.
            PlanningError: a joint's range is empty.
        """
        fields = ("limits_deg", "limits_mm")
        stated = values_by_joint_index(
            robot, self.limits_deg, self.limits_mm, fields, "joints", by_axis_name=True
        )
        limits = robot.axis_limits
        for index, joint in enumerate(robot.axes):
            to_si = (
                np.deg2rad
                if joint.type == "revolute"
                else (lambda millimetres: np.asarray(millimetres) / 1e3)
            )
            margin = to_si(self.margin_deg if joint.type == "revolute" else self.margin_mm)
            if index in stated:
                lower, upper = to_si(stated[index])
                limits[index] = max(lower, limits[index, 0]), min(upper, limits[index, 1])
            limits[index] += (margin, -margin)
            if not limits[index, 0] < limits[index, 1]:
                raise PlanningError(
                    f"the limits and margins leave no range for joint '{joint.name}'",
                    value=joint.name,
                    remedy="widen the limits or reduce the margins",
                )
        return torch.from_numpy(limits)


class Box(Section):
    """A box that the robot must not touch, and which blocks lines of sight.

    Attributes:
        name: name for messages.
        center_mm: centre in the robot's base frame [mm].
        size_mm: lengths of the edges along the axes of the box [mm].
        yaw_deg: rotation about the z axis of the robot's base frame [deg].
    """

    name: str = Field(min_length=1)
    center_mm: Point
    size_mm: tuple[Positive, Positive, Positive]
    yaw_deg: BoundedFloat = 0.0

    @property
    def center(self) -> Float64[Tensor, " 3"]:
        """Centre in the robot's base frame [m]."""
        return torch.tensor(self.center_mm, dtype=torch.float64) / 1e3

    @property
    def half_size(self) -> Float64[Tensor, " 3"]:
        """Half the lengths of the edges [m]."""
        return torch.tensor(self.size_mm, dtype=torch.float64) / 2e3

    @property
    def rotation(self) -> Float64[Tensor, "3 3"]:
        """Rotation matrix from the axes of the box to the robot's base frame."""
        return rotation_from_zyx(torch.tensor([np.deg2rad(self.yaw_deg), 0.0, 0.0], dtype=torch.float64))

    def to_box_frame(self, points: Float64[Tensor, "*batch 3"]) -> Float64[Tensor, "*batch 3"]:
        """Return points in the robot's base frame [m] transformed to the frame of the box."""
        return (points - self.center) @ self.rotation


class LinkSection(Section):
    """Radii of the links.

    Attributes:
        radius_mm: radius of all links [mm]; None for a share of the arm's length, see `capsules.RADIUS_SHARES`.
        radii_mm: radii of individual links by the names of their rows [mm].
    """

    radius_mm: Positive | None = None
    radii_mm: dict[str, Positive] = Field(default_factory=dict)


class ToolSection(FrameSection):
    """Pose of the reflector in the frame of the nominal tool (a URDF file's tip), in mm and deg.

    Attributes:
        radius_mm: radius of the reflector's bracket [mm].
    """

    radius_mm: Positive = TOOL_RADIUS * 1e3


class TrackerSection(Section):
    """Approximate position of the tracker in the robot's base frame.

    Attributes:
        x_mm: position along x [mm].
        y_mm: position along y [mm].
        z_mm: position along z [mm].
    """

    x_mm: BoundedFloat
    y_mm: BoundedFloat
    z_mm: BoundedFloat

    @property
    def position(self) -> Float64[Tensor, " 3"]:
        """Position in the robot's base frame [m]."""
        return torch.tensor([self.x_mm, self.y_mm, self.z_mm], dtype=torch.float64) / 1e3


class ReflectorSection(Section):
    """A reflector that is not turned to the tracker by hand at every pose.

    Attributes:
        name: name such as "cat's eye".
        axis: optical axis of the reflector in the frame of the tool.
        acceptance_deg: half the angle of the acceptance cone [deg].
    """

    name: str = "SMR of 1.5 inches"
    axis: Point = (0.0, 0.0, 1.0)
    acceptance_deg: Annotated[float, Field(gt=0, le=180)] = 30.0

    @model_validator(mode="after")
    def _has_direction(self) -> "ReflectorSection":
        if not any(self.axis):
            raise ValueError("axis: expected a direction such as [0, 0, 1], got the zero vector")
        return self


class LensSection(Section):
    """Lens data from which the depth of field of a camera is computed.

    Attributes:
        aperture: f-number.
        focus_mm: depth of the focus plane [mm].
        pixel_um: edge length of a pixel [um].
        blur_px: diameter of a point's image up to which it is treated as sharp [px].
    """

    aperture: Positive
    focus_mm: Positive
    pixel_um: Positive
    blur_px: Positive = 1.0

    def sharp_depths(self, f: float) -> tuple[float, float]:
        """Compute the nearest and the farthest sharp depth [m]; the farthest may be infinite.

        With the image at the distance v = f · pixel behind the lens, focused at s, the focal length is `v s / (v + s)`
        (thin lens), and a point at depth z has an image of diameter `A v |1/s - 1/z|` for the aperture A (Hecht,
        "Optics", section 5.2.3).

        Args:
            f: focal length of the focused camera [px].
        """
        s, pixel = self.focus_mm / 1e3, self.pixel_um / 1e6
        v = f * pixel
        opening = v * s / (v + s) / self.aperture
        reach = self.blur_px * pixel / (opening * v)
        return 1 / (1 / s + reach), 1 / (1 / s - reach) if reach < 1 / s else float("inf")


class ViewSection(Section):
    """Conditions under which a camera sees its board: completely, sharply, and not too obliquely.

    Attributes:
        frame: pose of the board, or of a fixed camera, in the robot's base frame; None if a model states it. The
            board's x axis runs along its rows, y from row to row, and z away from the viewer.
        near_mm: smallest depth of the board in front of the camera [mm]; None to compute it from the lens.
        far_mm: largest depth of the board [mm]; None to compute it from the lens.
        lens: lens data, needed if the depths are not stated.
        oblique_deg: largest angle between the board's normal and the line of sight [deg].
        margin_px: distance that the board keeps from the edges of the image [px].
    """

    frame: FrameSection | None = None
    near_mm: Positive | None = None
    far_mm: Positive | None = None
    lens: LensSection | None = None
    oblique_deg: Annotated[float, Field(gt=0, le=80)] = 45.0
    margin_px: NotNegative = 20.0

    @model_validator(mode="after")
    def _has_depths(self) -> "ViewSection":
        stated = self.near_mm is not None and self.far_mm is not None
        if (self.near_mm is None) != (self.far_mm is None) or stated == (self.lens is not None):
            raise ValueError(
                "expected near_mm and far_mm, or lens, to determine at which depths images are sharp"
            )
        if stated and not self.near_mm < self.far_mm:  # type: ignore[operator]
            raise ValueError(f"expected near_mm < far_mm, got {self.near_mm:g} and {self.far_mm:g}")
        return self

    @property
    def T_cell_frame(self) -> Float64[Tensor, "4 4"] | None:
        """Pose of the measuring frame in the frame of the nominal base [m]; None if it is not stated."""
        return None if self.frame is None else transform_from_xyz_zyx(torch.from_numpy(self.frame.to_si()))

    def sharp_depths(self, f: float) -> tuple[float, float]:
        """Return the nearest and the farthest depth [m] for a focal length f [px]."""
        if self.lens is not None:
            return self.lens.sharp_depths(f)
        assert self.near_mm is not None
        assert self.far_mm is not None
        return self.near_mm / 1e3, self.far_mm / 1e3


class Surroundings(Section):
    """Surroundings of a robot. All sections are optional, in the robot's base frame in mm and deg.

    Attributes:
        clearance_mm: distance that links and the tracker's beam keep from everything else [mm]; links keep half of it
            from each other.
        floor_mm: height of the floor [mm]; None for no floor.
        joints: joint margins and limits.
        boxes: boxes that the robot must not touch.
        links: radii of the links.
        tool: pose of the reflector, or of the camera or board on the flange; None for the tool of the robot.
        tracker: tracker that must see the reflector; None if the sensor needs no line of sight.
        reflector: reflector with an acceptance cone; None if it is turned to the tracker at every pose.
        view: conditions under which a camera sees its board; None without a camera.
    """

    clearance_mm: NotNegative = 20.0
    floor_mm: BoundedFloat | None = None
    joints: JointSection = JointSection()
    boxes: tuple[Box, ...] = Field(default=(), max_length=100)
    links: LinkSection = LinkSection()
    tool: ToolSection | None = None
    tracker: TrackerSection | None = None
    reflector: ReflectorSection | None = None
    view: ViewSection | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> "Surroundings":
        names = [box.name for box in self.boxes]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"the name '{twice[0]}' appears twice in boxes; names must differ")
        if self.reflector is not None and self.tracker is None:
            raise ValueError(
                "reflector is given without tracker; add the section tracker, or remove reflector"
            )
        for box in self.boxes if self.tracker is not None else ():
            assert self.tracker is not None
            if bool((box.to_box_frame(self.tracker.position).abs() <= box.half_size).all()):
                raise ValueError(f"the tracker is inside the box '{box.name}'; correct one of them")
        return self

    @property
    def clearance(self) -> float:
        """Distance that links and the tracker's beam keep from everything but the robot's other links [m]."""
        return self.clearance_mm / 1e3

    def robot_with_tool(self, robot: Robot) -> Robot:
        """Return the robot with the reflector as its tool; unchanged if the surroundings state no reflector."""
        if self.tool is None:
            return robot
        nominal_tool, reflector = (
            transform_from_xyz_zyx(torch.tensor(tool)) for tool in (robot.tool, self.tool.to_si())
        )
        return robot.with_geometry(tool=xyz_zyx_from_transform(nominal_tool @ reflector).numpy())

    def capsules(self, robot: Robot) -> Capsules:
        """Return capsules along the links of a robot and the bracket of its reflector."""
        radius = self.links.radius_mm
        radii = {name: size / 1e3 for name, size in self.links.radii_mm.items()}
        tool_radius = TOOL_RADIUS if self.tool is None else self.tool.radius_mm / 1e3
        return Capsules.from_robot(
            self.robot_with_tool(robot),
            robot.tool[:3],
            None if radius is None else radius / 1e3,
            radii,
            tool_radius,
        )


def read_surroundings(path: str | os.PathLike[str], robot: Robot) -> Surroundings:
    """Read a file of surroundings.

    Args:
        path: the YAML file.
        robot: robot in the surroundings.

    Raises:
        PlanningError: the file cannot be used, or it names links or joints that the robot lacks.
    """
    surroundings = read_yaml(path, Surroundings, PlanningError)
    names = [row.name for row in robot.rows]
    for name in surroundings.links.radii_mm:
        if name not in names:
            raise PlanningError(
                f"robot '{robot.name}' has no row '{name}'",
                value=name,
                at=place_of_key(path, ("links", "radii_mm", name)),
                remedy=choice_remedy(name, names),
            )
    try:
        surroundings.joints.limits(robot)
    except (RecipeError, PlanningError) as problem:
        raise problem.with_place(place_of_key(path, ("joints",)), PlanningError) from None
    return surroundings
