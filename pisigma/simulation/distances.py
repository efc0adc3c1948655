"""Simulated distances (draw wire from an anchor, ball bar between two poses), and a simulated ball in sockets."""

from typing import Literal

import torch
from jaxtyping import Float64
from pydantic import Field, field_validator, model_validator
from torch import Tensor

from pisigma.files.errors import RecipeError
from pisigma.files.yaml_file import Count, Section, Seed
from pisigma.measurement.dataset import Measurements
from pisigma.robot.se3 import transform
from pisigma.simulation.commanded import AbstractCommandedJoints, BranchSection, joints_for_poses
from pisigma.simulation.noise import SensorNoise, draw_noise, row_sigma
from pisigma.simulation.poses import OrientationSection
from pisigma.simulation.true_robot import TrueRobot


class SocketSection(Section):
    """A fixed point that holds the ball.

    Attributes:
        name: name of the socket.
        point_mm: position of the socket in the base frame [mm], which measurements do not state.
    """

    name: str = Field(min_length=1)
    point_mm: tuple[float, float, float]


class SimulatedSockets(Section):
    """Section of a recipe for sockets in which the ball sits, and for the tool's orientations there.

    Attributes:
        kind: "sockets".
        sockets: the sockets.
        poses_per_socket: number of orientations of the tool in every socket.
        orientation: orientations of the tool, which are drawn from one generator in the order of the sockets.
        seed: random seed of the orientations.
        branch: branch of the nominal robot's inverse kinematics.
        noise: noise, where `sensor_mm` is the play of the ball per axis; no noise by default.
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
            raise ValueError(f"the socket '{twice[0]}' appears twice; rename one")
        return sockets

    def measure(self, robot: TrueRobot) -> Measurements:
        """Return joint values with which the true tool point is in the sockets; every call returns the same values.

        With noise, `FK_true(q) + n_robot = socket + n_sensor`.

        Raises:
            UnreachablePoseError: the robot does not reach a socket with an orientation.
            RecipeError: joint values are outside the limits of the robot.
        """
        points = torch.tensor([socket.point_mm for socket in self.sockets], dtype=torch.float64) / 1e3
        points = points.repeat_interleave(self.poses_per_socket, 0)
        draws = draw_noise(self.noise, len(points))
        generator = torch.Generator().manual_seed(self.seed)
        R = self.orientation.rotations(len(points), generator)
        T = transform(R, points + draws.sensor - draws.robot)
        names = [socket.name for socket in self.sockets for _ in range(self.poses_per_socket)]
        return Measurements(
            q=joints_for_poses(robot, T, self.branch.start_joints(robot.nominal, T)),
            socket=tuple(names),
            sigma_position=row_sigma(self.noise, len(points)),
            source=f"simulation of {robot.nominal.name}",
        )


class AnchorSection(Section):
    """A fixed point from which a wire is drawn.

    Attributes:
        name: name of the anchor.
        point_mm: position of the anchor in the base frame [mm].
        zero_mm: zero offset of the sensor [mm].
        known: whether measurements state the position of the anchor.
    """

    name: str = Field(min_length=1)
    point_mm: tuple[float, float, float]
    zero_mm: float = 0.0
    known: bool = False


class SimulatedDistances(AbstractCommandedJoints):
    """Section of a recipe for distances from an anchor.

    Attributes:
        kind: "distances".
        anchor: the anchor.
        noise: noise of sensor and robot; no noise by default.
    """

    kind: Literal["distances"]
    anchor: AnchorSection
    noise: SensorNoise | None = None

    def measure(self, robot: TrueRobot) -> Measurements:
        """Return the distances `|FK_true(q) + n_robot - anchor| + zero + n_sensor`; every call returns the same.

        Raises:
            RecipeError: a distance is negative.
        """
        q = self.commanded_joints(robot)
        draws = draw_noise(self.noise, len(q))
        anchor = torch.tensor(self.anchor.point_mm, dtype=torch.float64) / 1e3
        approach = robot.draw_approach(q)
        vector = robot.forward(q, approach)[:, :3, 3] + draws.robot - anchor
        shown = vector.norm(dim=-1) + self.anchor.zero_mm / 1e3 + draws.sensor[:, 0]
        return Measurements(
            q=q,
            distance=_not_negative(shown),
            anchor=(self.anchor.name,) * len(q),
            anchor_place=anchor.expand(len(q), 3).clone() if self.anchor.known else None,
            sigma_position=row_sigma(self.noise, len(q)),
            approach=approach,
            source=f"simulation of {robot.nominal.name}",
        )


class SimulatedPairs(AbstractCommandedJoints):
    """Section of a recipe for distances between pairs of poses: poses 1 and 2, poses 3 and 4, and so on.

    Attributes:
        kind: "pairs".
        name: name of the pairs, to which their number from 0 is appended.
        noise: noise of the sensor and of the robot in both poses; no noise by default.
    """

    kind: Literal["pairs"]
    name: str = "pair"
    noise: SensorNoise | None = None

    @model_validator(mode="after")
    def _even(self) -> "SimulatedPairs":
        if getattr(self.poses, "count", 0) % 2:
            raise ValueError("expected an even number of poses, because they form pairs")
        return self

    def measure(self, robot: TrueRobot) -> Measurements:
        """Return the distances `|p_1 - p_2| + n_sensor` of `p = FK_true(q) + n_robot`; every call returns the same.

        Raises:
            RecipeError: the number of poses is odd, or a distance is negative.
        """
        q = self.commanded_joints(robot)
        if len(q) % 2:
            raise RecipeError(
                option="pairs", expected="an even number of poses", value=len(q), remedy="add or remove one"
            )
        draws = draw_noise(self.noise, len(q))
        approach = robot.draw_approach(q)
        position = (robot.forward(q, approach)[:, :3, 3] + draws.robot).reshape(-1, 2, 3)
        shown = (position[:, 0] - position[:, 1]).norm(dim=-1) + draws.sensor[::2, 0]
        return Measurements(
            q=q,
            distance=_not_negative(shown).repeat_interleave(2),
            pair=tuple(f"{self.name} {row // 2}" for row in range(len(q))),
            sigma_position=row_sigma(self.noise, len(q), points=2),
            approach=approach,
            source=f"simulation of {robot.nominal.name}",
        )


def _not_negative(shown: Float64[Tensor, " rows"]) -> Float64[Tensor, " rows"]:
    if (shown < 0).any():
        row = int(shown.argmin())
        raise RecipeError(
            option="distances",
            expected=f"a distance of 0 mm or more at pose {row} (counted from 0)",
            value=float(f"{float(shown[row]) * 1e3:.6g}"),
            remedy="choose poses farther away, less noise, or a larger zero_mm",
        )
    return shown
