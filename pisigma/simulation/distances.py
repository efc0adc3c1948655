"""Distances and sockets: a draw wire from an anchor, a ball bar between two poses, a ball in fixed points."""

from typing import Literal

import torch
from jaxtyping import Float64
from pydantic import Field, field_validator, model_validator
from torch import Tensor

from pisigma.files.errors import RecipeError
from pisigma.files.yaml_file import Count, Section, Seed
from pisigma.measurement.dataset import Measurements
from pisigma.robot.se3 import transform
from pisigma.simulation.commanded import AbstractCommanded, BranchSection, joints_for_poses
from pisigma.simulation.noise import SensorNoise, draw_noise, row_sigma
from pisigma.simulation.poses import OrientationSection
from pisigma.simulation.true_robot import TrueRobot


class SocketSection(Section):
    """A fixed point that holds the ball.

    Attributes:
        name: of the socket.
        point_mm: where it is, in the base frame [mm]; the measurements do not tell it.
    """

    name: str = Field(min_length=1)
    point_mm: tuple[float, float, float]


class SimulatedSockets(Section):
    """The part of a recipe that states which sockets the ball sits in, and how the tool is turned there.

    Attributes:
        kind: "sockets".
        sockets: the fixed points.
        poses_per_socket: how many orientations of the tool in every one.
        orientation: of the tool; all are drawn from one generator, those of the first socket first.
        seed: of the generator of the orientations.
        branch: on which branch the nominal robot would reach them.
        noise: `sensor_mm` is the play of the ball per axis; left out, there is none.
    """

    kind: Literal["sockets"]
    sockets: tuple[SocketSection, ...] = Field(min_length=1)
    poses_per_socket: Count
    orientation: OrientationSection
    seed: Seed
    branch: BranchSection
    noise: SensorNoise | None = None

    @field_validator("sockets")
    @classmethod
    def _names_differ(cls, sockets: tuple[SocketSection, ...]) -> tuple[SocketSection, ...]:
        names = [socket.name for socket in sockets]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"the socket '{twice[0]}' stands twice; names must differ")
        return sockets

    def measure(self, robot: TrueRobot) -> Measurements:
        """Joint values to command such that the true tool point is in the socket, the same at every call.

        The tool point is at the socket but for the noise: `FK_true(q) + n_robot = socket + n_sensor`.

        Raises:
            UnreachablePoseError: the robot does not reach a socket with an orientation.
            RecipeError: joint values would have to leave the limits of the robot.
        """
        points = torch.tensor([socket.point_mm for socket in self.sockets], dtype=torch.float64) / 1e3
        points = points.repeat_interleave(self.poses_per_socket, 0)
        draws = draw_noise(self.noise, len(points))
        generator = torch.Generator().manual_seed(self.seed)
        R = self.orientation.rotations(len(points), generator)
        T = transform(R, points + draws.sensor - draws.robot)
        names = [socket.name for socket in self.sockets for _ in range(self.poses_per_socket)]
        return Measurements(
            q=joints_for_poses(robot, T, self.branch.start(robot.nominal, T)),
            socket=tuple(names),
            sigma_position=row_sigma(self.noise, len(points)),
            source=f"simulation of {robot.nominal.name}",
        )


class AnchorSection(Section):
    """A fixed point from which a wire is drawn.

    Attributes:
        name: of the anchor.
        point_mm: where it is, in the base frame [mm].
        zero_mm: what the sensor shows at no distance [mm].
        known: whether the measurements tell its place.
    """

    name: str = Field(min_length=1)
    point_mm: tuple[float, float, float]
    zero_mm: float = 0.0
    known: bool = False


class SimulatedDistances(AbstractCommanded):
    """The part of a recipe that states distances from an anchor.

    Attributes:
        kind: "distances".
        anchor: where they are measured from.
        noise: of the sensor and of the robot; left out, both are exact.
    """

    kind: Literal["distances"]
    anchor: AnchorSection
    noise: SensorNoise | None = None

    def measure(self, robot: TrueRobot) -> Measurements:
        """The distances `|FK_true(q) + n_robot - anchor| + zero + n_sensor`, the same at every call.

        Raises:
            RecipeError: a distance is below 0.
        """
        q = self.commanded(robot)
        draws = draw_noise(self.noise, len(q))
        anchor = torch.tensor(self.anchor.point_mm, dtype=torch.float64) / 1e3
        approach = robot.draw_approach(q)
        away = robot.forward(q, approach)[:, :3, 3] + draws.robot - anchor
        shown = away.norm(dim=-1) + self.anchor.zero_mm / 1e3 + draws.sensor[:, 0]
        return Measurements(
            q=q,
            distance=_not_below_zero(shown),
            anchor=(self.anchor.name,) * len(q),
            anchor_place=anchor.expand(len(q), 3).clone() if self.anchor.known else None,
            sigma_position=row_sigma(self.noise, len(q)),
            approach=approach,
            source=f"simulation of {robot.nominal.name}",
        )


class SimulatedPairs(AbstractCommanded):
    """The part of a recipe that states distances between two poses each: the first and the second, and so on.

    Attributes:
        kind: "pairs".
        name: of the pairs, which are numbered from 0 behind it.
        noise: of the sensor and of the robot, whose two poses both deviate; left out, both are exact.
    """

    kind: Literal["pairs"]
    name: str = "pair"
    noise: SensorNoise | None = None

    @model_validator(mode="after")
    def _even(self) -> "SimulatedPairs":
        if getattr(self.poses, "count", 0) % 2:
            raise ValueError("poses are taken two at a time; ask for an even number of them")
        return self

    def measure(self, robot: TrueRobot) -> Measurements:
        """The distances `|p_1 - p_2| + n_sensor` of `p = FK_true(q) + n_robot`, the same at every call.

        Raises:
            RecipeError: the number of poses is odd, or a distance is below 0.
        """
        q = self.commanded(robot)
        if len(q) % 2:
            raise RecipeError(f"pairs: an even number of poses was wanted, got {len(q)}; add or remove one.")
        draws = draw_noise(self.noise, len(q))
        approach = robot.draw_approach(q)
        position = (robot.forward(q, approach)[:, :3, 3] + draws.robot).reshape(-1, 2, 3)
        shown = (position[:, 0] - position[:, 1]).norm(dim=-1) + draws.sensor[::2, 0]
        return Measurements(
            q=q,
            distance=_not_below_zero(shown).repeat_interleave(2),
            pair=tuple(f"{self.name} {row // 2}" for row in range(len(q))),
            sigma_position=row_sigma(self.noise, len(q), points=2),
            approach=approach,
            source=f"simulation of {robot.nominal.name}",
        )


def _not_below_zero(shown: Float64[Tensor, " rows"]) -> Float64[Tensor, " rows"]:
    if (shown < 0).any():
        row = int(shown.argmin())
        raise RecipeError(
            f"distances: the sensor would show {float(shown[row]) * 1e3:.6g} mm at pose {row} (counted from 0); "
            "state poses farther away, less noise, or a larger zero_mm."
        )
    return shown
