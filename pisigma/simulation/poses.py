"""Poses to measure: desired poses on grids or at random, or random joint values."""

import math
from abc import ABC, abstractmethod
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float64
from pydantic import Field, field_validator, model_validator
from torch import Tensor

from pisigma.files.errors import Phrase, RecipeError
from pisigma.files.yaml_file import MAX_POSES, Count, Section, Seed
from pisigma.robot.description import Robot
from pisigma.robot.se3 import rotation_from_zyx, transform
from pisigma.simulation.errors.source import values_by_joint_index

Triple = tuple[float, float, float]


class OrientationSection(Section):
    """Orientations `R_home · RotZ(roll) · RotY(pitch) · RotX(yaw)`, with each angle uniform in ±spread.

    Source: Jeong, Kim and Kwak 1998, section 4.2.1 and appendix B.

    Attributes:
        home_rpy_deg: R_home as roll, pitch, yaw [deg].
        home_rotation: R_home as the three rows of a rotation matrix, instead of `home_rpy_deg`.
        spread_deg: half the range of roll, pitch and yaw [deg]; if 0, all poses have the home orientation.
    """

    home_rpy_deg: Triple | None = None
    home_rotation: tuple[Triple, Triple, Triple] | None = None
    spread_deg: float = Field(default=0.0, ge=0, le=180)

    @field_validator("home_rotation")
    @classmethod
    def _is_rotation(cls, rows: tuple[Triple, Triple, Triple] | None) -> tuple[Triple, Triple, Triple] | None:
        if rows is not None:
            R = torch.tensor(rows, dtype=torch.float64)
            deviation = (R.mT @ R - torch.eye(3, dtype=torch.float64)).abs().max()
            if deviation > 1e-9 or torch.linalg.det(R) < 0:
                raise ValueError("expected the three rows of an orthonormal, right-handed rotation matrix")
        return rows

    @model_validator(mode="after")
    def _one_home(self) -> "OrientationSection":
        if self.home_rpy_deg is not None and self.home_rotation is not None:
            raise ValueError("expected either home_rpy_deg or home_rotation, got both")
        return self

    def rotations(self, count: int, generator: torch.Generator | None) -> Float64[Tensor, "count 3 3"]:
        """Return one orientation per pose.

        Args:
            count: number of orientations.
            generator: random generator of roll, pitch, yaw, drawn as one (count, 3) block; not used without a spread.
        """
        if self.home_rotation is not None:
            home = torch.tensor(self.home_rotation, dtype=torch.float64)
        else:
            rpy_deg = torch.tensor(self.home_rpy_deg or (0.0,) * 3, dtype=torch.float64)
            home = rotation_from_zyx(torch.deg2rad(rpy_deg))
        if not self.spread_deg:
            return home.expand(count, 3, 3).clone()
        draws = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
        return home @ rotation_from_zyx(torch.deg2rad(self.spread_deg * draws))


_EXTRA_DRAWS = 9
"""Number of additional draws per joint vector for coupled joints, whose stops exclude some draws."""

Range = tuple[float, float]
"""Smallest and largest value of a range."""


class JointsRandom(Section):
    """Random joint values, uniform and independent, drawn as one (count, dof) block.

    Attributes:
        kind: "joints_random".
        count: number of joint vectors.
        seed: random seed.
        range_fraction: fraction of the range between the joint limits, about its centre, that is used.
        range_deg: smallest and largest value [deg] by name of a revolute joint, instead of the fraction.
        range_mm: smallest and largest value [mm] by name of a prismatic joint, instead of the fraction.
    """

    kind: Literal["joints_random"]
    count: Count
    seed: Seed
    range_fraction: float = Field(default=1.0, gt=0, le=1)
    range_deg: dict[str, Range] = Field(default_factory=dict)
    range_mm: dict[str, Range] = Field(default_factory=dict)

    def joints(self, robot: Robot) -> Float64[Tensor, "count dof"]:
        """Return the joint values to command [rad or m]; every call returns the same values.

        The controller's values are drawn and converted to joint values.

        Raises:
            RecipeError: a joint is unknown, has a range in the wrong unit or outside its limits, or has no limits.
        """
        bounds = torch.from_numpy(self._bounds(robot))
        generator = torch.Generator().manual_seed(self.seed)

        def sample() -> Tensor:
            draws = torch.rand(self.count, len(bounds), generator=generator, dtype=torch.float64)
            q: Tensor = robot.to_dh(bounds[:, 0] + (bounds[:, 1] - bounds[:, 0]) * draws)
            return q

        q = sample()
        if robot.coupling is None or not robot.coupling.stops:
            return q
        many = torch.cat([q] + [sample() for _ in range(_EXTRA_DRAWS)])
        kept = many[torch.from_numpy(robot.coupling.is_within_limits(many.numpy()))]
        if len(kept) < self.count:
            raise RecipeError(
                option="joints_random",
                expected=f"{self.count} of {len(many)} random joint vectors within the stops of robot '{robot.name}'",
                value=len(kept),
                remedy="narrow the ranges",
            )
        return kept[: self.count]

    def _bounds(self, robot: Robot) -> Float64[np.ndarray, "axes 2"]:
        limits = robot.axis_limits
        with np.errstate(invalid="ignore"):  # joints without limits are refused later
            middle, half = limits.mean(1, keepdims=True), np.diff(limits) / 2
            bounds: np.ndarray = middle + self.range_fraction * half * np.array([-1.0, 1.0])
        fields = ("range_deg", "range_mm")
        ranges = values_by_joint_index(
            robot, self.range_deg, self.range_mm, fields, "joints_random", by_axis_name=True
        )
        for index, stated in ranges.items():
            is_revolute = robot.axes[index].type == "revolute"
            bounds[index] = np.deg2rad(stated) if is_revolute else np.array(stated) / 1e3
        for joint, (lower, upper) in zip(robot.axes, bounds, strict=True):
            if not np.isfinite([lower, upper]).all():
                raise RecipeError(
                    f"joint '{joint.name}' of robot '{robot.name}' has no limits",
                    option="joints_random",
                    value=joint.name,
                    remedy="give its range in range_deg or range_mm",
                )
            if not joint.lower - 1e-12 <= lower <= upper <= joint.upper + 1e-12:
                raise RecipeError(
                    option="joints_random",
                    expected=f"a range of joint '{joint.name}' within its limits {joint.lower:g} to {joint.upper:g} "
                    f"{'rad' if joint.type == 'revolute' else 'm'}",
                    value=Phrase(f"{lower:g} to {upper:g}"),
                )
        return bounds


def _check_count(count: int) -> None:
    if count > MAX_POSES:
        raise ValueError(f"expected a grid of at most {MAX_POSES:,} poses, got {count:,}; choose fewer steps")


class AbstractPoses(Section, ABC):
    """Base class of sections of desired tool poses.

    Random values come from one generator with the section's seed, positions before orientations. Grids need a seed
    only if orientations have a spread.
    """

    orientation: OrientationSection = OrientationSection()
    seed: Seed | None = None

    @model_validator(mode="after")
    def _seed_for_spread(self) -> "AbstractPoses":
        if self.orientation.spread_deg and self.seed is None:
            raise ValueError("a spread of orientations is random and needs a seed; add it")
        return self

    def transforms(self) -> Float64[Tensor, "count 4 4"]:
        """Return the desired T_base_tool [m]; every call returns the same poses."""
        generator = None if self.seed is None else torch.Generator().manual_seed(self.seed)
        positions = self._positions(generator)
        return transform(self.orientation.rotations(len(positions), generator), positions)

    @abstractmethod
    def _positions(self, generator: torch.Generator | None) -> Float64[Tensor, "count 3"]:
        """Return the desired positions [m]."""


class PolarGrid(AbstractPoses):
    """Grid with equal steps of radius and angle at one height: `x = r cos(phi)`, `y = r sin(phi)`; phi varies fastest.

    Source: Jeong, Kim and Kwak 1998, section 4.1.1 and Fig. 4.

    Attributes:
        kind: "polar_grid".
        r_mm: first and last radius [mm].
        r_steps: number of radii.
        phi_deg: first and last angle [deg].
        phi_steps: number of angles.
        z_mm: height [mm].
        orientation: orientations of the tool.
        seed: random seed of the orientations, if they have a spread.
    """

    kind: Literal["polar_grid"]
    r_mm: Range
    r_steps: Count
    phi_deg: Range
    phi_steps: Count
    z_mm: float

    @model_validator(mode="after")
    def _not_too_many(self) -> "PolarGrid":
        _check_count(self.r_steps * self.phi_steps)
        return self

    def _positions(self, generator: torch.Generator | None) -> Float64[Tensor, "count 3"]:
        r = _linspace(self.r_mm, self.r_steps) / 1e3
        phi = torch.deg2rad(_linspace(self.phi_deg, self.phi_steps))
        points = torch.cartesian_prod(r, phi).reshape(-1, 2)
        return _from_polar(points[:, 0], points[:, 1], self.z_mm / 1e3)


class CubeGrid(AbstractPoses):
    """Grid with equal steps along x, y and z; z varies fastest.

    Source: Jeong, Kim and Kwak 1998, section 4.2.1, according to ISO 9283.

    Attributes:
        kind: "cube_grid".
        x_mm: first and last x [mm].
        y_mm: first and last y [mm].
        z_mm: first and last z [mm].
        steps: numbers of values of x, y and z.
        orientation: orientations of the tool.
        seed: random seed of the orientations, if they have a spread.
    """

    kind: Literal["cube_grid"]
    x_mm: Range
    y_mm: Range
    z_mm: Range
    steps: tuple[Count, Count, Count]

    @model_validator(mode="after")
    def _not_too_many(self) -> "CubeGrid":
        _check_count(math.prod(self.steps))
        return self

    def _positions(self, generator: torch.Generator | None) -> Float64[Tensor, "count 3"]:
        ranges = (self.x_mm, self.y_mm, self.z_mm)
        return torch.cartesian_prod(*(_linspace(r, n) / 1e3 for r, n in zip(ranges, self.steps, strict=True)))


class PolarRandom(AbstractPoses):
    """Random poses in a polar region, uniform in radius and angle, and therefore denser towards the centre.

    First a (count, 2) block of numbers is drawn for r and phi, then the orientations.

    Attributes:
        kind: "polar_random".
        count: number of poses.
        seed: random seed.
        r_mm: smallest and largest radius [mm].
        phi_deg: smallest and largest angle [deg].
        z_mm: height [mm].
        orientation: orientations of the tool.
    """

    kind: Literal["polar_random"]
    count: Count
    seed: Seed
    r_mm: Range
    phi_deg: Range
    z_mm: float

    def _positions(self, generator: torch.Generator | None) -> Float64[Tensor, "count 3"]:
        draws = _uniform(self.count, [self.r_mm, self.phi_deg], generator)
        return _from_polar(draws[:, 0] / 1e3, torch.deg2rad(draws[:, 1]), self.z_mm / 1e3)


class CubeRandom(AbstractPoses):
    """Random poses in a cuboid, uniform in x, y and z.

    First a (count, 3) block of numbers is drawn for x, y and z, then the orientations.

    Attributes:
        kind: "cube_random".
        count: number of poses.
        seed: random seed.
        x_mm: smallest and largest x [mm].
        y_mm: smallest and largest y [mm].
        z_mm: smallest and largest z [mm].
        orientation: orientations of the tool.
    """

    kind: Literal["cube_random"]
    count: Count
    seed: Seed
    x_mm: Range
    y_mm: Range
    z_mm: Range

    def _positions(self, generator: torch.Generator | None) -> Float64[Tensor, "count 3"]:
        return _uniform(self.count, [self.x_mm, self.y_mm, self.z_mm], generator) / 1e3


WhereToMeasure = Annotated[
    PolarGrid | CubeGrid | PolarRandom | CubeRandom | JointsRandom, Field(discriminator="kind")
]
"""Section of desired poses or joint values to command, distinguished by `kind`."""


def _linspace(bounds: Range, steps: int) -> Float64[Tensor, " steps"]:
    return torch.linspace(bounds[0], bounds[1], steps, dtype=torch.float64)


def _from_polar(
    r: Float64[Tensor, " count"], phi: Float64[Tensor, " count"], z: float
) -> Float64[Tensor, "count 3"]:
    return torch.stack([r * torch.cos(phi), r * torch.sin(phi), torch.full_like(r, z)], -1)


def _uniform(
    count: int, bounds: list[Range], generator: torch.Generator | None
) -> Float64[Tensor, "count columns"]:
    lower, upper = torch.tensor(bounds, dtype=torch.float64).unbind(-1)
    return lower + (upper - lower) * torch.rand(count, len(bounds), generator=generator, dtype=torch.float64)
