"""Sockets: a ball at the tool sits in fixed points, with several orientations of the tool."""

from typing import Literal

import torch
from jaxtyping import Float64
from pydantic import Field, field_validator
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.se3 import transform
from pisigma.simulation.branch import BranchSection
from pisigma.simulation.commanded import joints_for_poses
from pisigma.simulation.orientation import OrientationSection
from pisigma.simulation.sensor_noise import SensorNoise, draw_noise, row_sigma
from pisigma.simulation.true_robot import TrueRobot
from pisigma.yaml_file import Section


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
    poses_per_socket: int = Field(ge=1)
    orientation: OrientationSection
    seed: int = Field(ge=0)
    branch: BranchSection
    noise: SensorNoise | None = None

    @field_validator("sockets")
    @classmethod
    def _names_differ(cls, sockets: tuple[SocketSection, ...]) -> tuple[SocketSection, ...]:
        names = [socket.name for socket in sockets]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"the socket '{name}' stands twice; names must differ")
        return sockets

    def measure(self, robot: TrueRobot) -> Measurements:
        """Joint values to command such that the true tool point is in the socket, the same at every call.

        The tool point is at the socket but for the noise: `FK_true(q) + n_robot = socket + n_sensor`.

        Raises:
            UnreachablePoseError: the robot does not reach a socket with an orientation.
            RecipeError: joint values would have to leave the limits of the robot.
        """
        points = self._points().repeat_interleave(self.poses_per_socket, 0)
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

    def _points(self) -> Float64[Tensor, "sockets 3"]:
        return torch.tensor([socket.point_mm for socket in self.sockets], dtype=torch.float64) / 1e3
