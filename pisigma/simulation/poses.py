"""Where to measure: wanted poses on grids or at random."""

from abc import ABC, abstractmethod
from typing import Annotated, Literal

import torch
from jaxtyping import Float64
from pydantic import Field, model_validator
from torch import Tensor

from pisigma.se3 import transform
from pisigma.simulation.orientation import OrientationSection
from pisigma.simulation.random_joints import JointsRandom
from pisigma.yaml_file import Section

Range = tuple[float, float]
"""First and last value."""
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0)]


class AbstractPoses(Section, ABC):
    """Wanted tool poses; whatever is random comes from one generator with the section's seed."""

    @abstractmethod
    def transforms(self) -> Float64[Tensor, "count 4 4"]:
        """The wanted T_base_tool [m], the same at every call."""


class AbstractGrid(AbstractPoses):
    """What grids share: a seed is needed for a spread of orientations only."""

    orientation: OrientationSection = OrientationSection()
    seed: Seed | None = None

    @model_validator(mode="after")
    def _seed_for_spread(self) -> "AbstractGrid":
        if self.orientation.spread_deg and self.seed is None:
            raise ValueError("a spread of orientations is drawn at random; state the seed")
        return self

    def _at(self, positions: Float64[Tensor, "count 3"]) -> Float64[Tensor, "count 4 4"]:
        generator = None if self.seed is None else torch.Generator().manual_seed(self.seed)
        return transform(self.orientation.rotations(len(positions), generator), positions)


class PolarGrid(AbstractGrid):
    """Equal steps of radius and angle at one height: `x = r cos(phi)`, `y = r sin(phi)`; phi runs fastest.

    Source: Jeong, Kim and Kwak 1998, section 4.1.1 and Fig. 4.

    Attributes:
        kind: "polar_grid".
        r_mm: first and last radius [mm].
        r_steps: how many radii.
        phi_deg: first and last angle [deg].
        phi_steps: how many angles.
        z_mm: height [mm].
        orientation: of the tool.
        seed: for the spread of the orientation, if it has one.
    """

    kind: Literal["polar_grid"]
    r_mm: Range
    r_steps: Count
    phi_deg: Range
    phi_steps: Count
    z_mm: float

    def transforms(self) -> Float64[Tensor, "count 4 4"]:
        """The grid. See `AbstractPoses.transforms`."""
        r = _linspace(self.r_mm, self.r_steps) / 1e3
        phi = torch.deg2rad(_linspace(self.phi_deg, self.phi_steps))
        points = torch.cartesian_prod(r, phi).reshape(-1, 2)
        return self._at(_from_polar(points[:, 0], points[:, 1], self.z_mm / 1e3))


class CubeGrid(AbstractGrid):
    """Equal steps along x, y and z; z runs fastest.

    Source: Jeong, Kim and Kwak 1998, section 4.2.1, after ISO 9283.

    Attributes:
        kind: "cube_grid".
        x_mm: first and last x [mm].
        y_mm: first and last y [mm].
        z_mm: first and last z [mm].
        steps: how many values of x, y and z.
        orientation: of the tool.
        seed: for the spread of the orientation, if it has one.
    """

    kind: Literal["cube_grid"]
    x_mm: Range
    y_mm: Range
    z_mm: Range
    steps: tuple[Count, Count, Count]

    def transforms(self) -> Float64[Tensor, "count 4 4"]:
        """The grid. See `AbstractPoses.transforms`."""
        axes = [
            _linspace(r, n) / 1e3 for r, n in zip((self.x_mm, self.y_mm, self.z_mm), self.steps, strict=True)
        ]
        return self._at(torch.cartesian_prod(*axes))


class PolarRandom(AbstractPoses):
    """Random poses of a polar region, uniform in radius and angle (so denser towards the centre).

    Drawn as a (count, 2) block for r and phi, then the orientations.

    Attributes:
        kind: "polar_random".
        count: how many poses.
        seed: of the generator.
        r_mm: smallest and largest radius [mm].
        phi_deg: smallest and largest angle [deg].
        z_mm: height [mm].
        orientation: of the tool.
    """

    kind: Literal["polar_random"]
    count: Count
    seed: Seed
    r_mm: Range
    phi_deg: Range
    z_mm: float
    orientation: OrientationSection = OrientationSection()

    def transforms(self) -> Float64[Tensor, "count 4 4"]:
        """The poses. See `AbstractPoses.transforms`."""
        generator = torch.Generator().manual_seed(self.seed)
        draws = _uniform(self.count, [self.r_mm, self.phi_deg], generator)
        positions = _from_polar(draws[:, 0] / 1e3, torch.deg2rad(draws[:, 1]), self.z_mm / 1e3)
        return transform(self.orientation.rotations(self.count, generator), positions)


class CubeRandom(AbstractPoses):
    """Random poses of a cuboid, uniform in x, y and z.

    Drawn as a (count, 3) block for x, y and z, then the orientations.

    Attributes:
        kind: "cube_random".
        count: how many poses.
        seed: of the generator.
        x_mm: smallest and largest x [mm].
        y_mm: smallest and largest y [mm].
        z_mm: smallest and largest z [mm].
        orientation: of the tool.
    """

    kind: Literal["cube_random"]
    count: Count
    seed: Seed
    x_mm: Range
    y_mm: Range
    z_mm: Range
    orientation: OrientationSection = OrientationSection()

    def transforms(self) -> Float64[Tensor, "count 4 4"]:
        """The poses. See `AbstractPoses.transforms`."""
        generator = torch.Generator().manual_seed(self.seed)
        positions = _uniform(self.count, [self.x_mm, self.y_mm, self.z_mm], generator) / 1e3
        return transform(self.orientation.rotations(self.count, generator), positions)


WhereToMeasure = Annotated[
    PolarGrid | CubeGrid | PolarRandom | CubeRandom | JointsRandom, Field(discriminator="kind")
]
"""Wanted poses or joint values to command, told apart by `kind`."""


def _linspace(bounds: Range, steps: int) -> Float64[Tensor, " steps"]:
    return torch.linspace(bounds[0], bounds[1], steps, dtype=torch.float64)


def _from_polar(
    r: Float64[Tensor, " count"], phi: Float64[Tensor, " count"], z: float
) -> Float64[Tensor, "count 3"]:
    return torch.stack([r * torch.cos(phi), r * torch.sin(phi), torch.full_like(r, z)], -1)


def _uniform(count: int, bounds: list[Range], generator: torch.Generator) -> Float64[Tensor, "count columns"]:
    lower, upper = torch.tensor(bounds, dtype=torch.float64).unbind(-1)
    return lower + (upper - lower) * torch.rand(count, len(bounds), generator=generator, dtype=torch.float64)
