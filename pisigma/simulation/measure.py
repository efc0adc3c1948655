"""Measurements that sensors would make on the true robot: of a tracker, or of several sensors together."""

from dataclasses import replace
from typing import Annotated, Literal

import torch
from jaxtyping import Float64
from pydantic import Discriminator, Field, Tag
from torch import Tensor

from pisigma.files.yaml_file import Section
from pisigma.measurement.dataset import Measurements, join
from pisigma.simulation.camera.simulated_images import SimulatedImages
from pisigma.simulation.commanded import AbstractCommanded
from pisigma.simulation.distances import SimulatedDistances, SimulatedPairs, SimulatedSockets
from pisigma.simulation.noise import MeasurementNoise
from pisigma.simulation.touching import SimulatedTouches
from pisigma.simulation.true_robot import TrueRobot


class SimulatedMeasurements(AbstractCommanded):
    """The part of a recipe that states what a tracker measures on the true robot.

    Attributes:
        kind: "tracker"; need not be stated where nothing else can stand.
        sensor: "pose" (position and orientation) or "position".
        noise: of the sensor; left out, it measures exactly.
        frame: name of the tracker's frame, which is the robot's base frame.
        target: name of what is measured on the robot.
    """

    kind: Literal["tracker"] = "tracker"
    sensor: Literal["pose", "position"] = "pose"
    noise: MeasurementNoise | None = None
    frame: str = ""
    target: str = ""

    def measure(self, robot: TrueRobot) -> Measurements:
        """Simulate the measurements, the same at every call. See `simulate`."""
        measured = simulate(robot, self.commanded(robot), self.sensor, self.noise)
        rows = measured.rows
        return replace(measured, frame=(self.frame,) * rows, target=(self.target,) * rows)


def simulate(
    robot: TrueRobot,
    q: Float64[Tensor, "rows dof"],
    sensor: Literal["pose", "position"] = "pose",
    noise: MeasurementNoise | None = None,
) -> Measurements:
    """Command joint values and measure where the true robot takes its tool.

    Args:
        robot: the true robot.
        q: commanded joint values [rad or m], as the controller counts.
        sensor: whether the orientation is measured too. The sensor's frame is the robot's base frame.
        noise: of the sensor; None measures exactly.

    Returns:
        One row per commanded joint vector, with the standard deviations of the noise where there is any, and with
        the sides from which the joints come, drawn at random, where they have play.

    Raises:
        PoseError: q has another number of columns than the robot has joints.
    """
    approach = robot.draw_approach(q)
    T = robot.forward(q, approach)
    T = T if noise is None else noise.apply(T)
    pose = sensor == "pose"
    return Measurements(
        q=q,
        position=T[:, :3, 3].clone(),
        rotation=T[:, :3, :3].clone() if pose else None,
        sigma_position=_sigma(q, 0.0 if noise is None else noise.sigma_position),
        sigma_rotation=_sigma(q, noise.sigma_rotation if noise is not None and pose else 0.0),
        approach=approach,
        source=f"simulation of {robot.nominal.name}",
    )


def _sigma(q: Float64[Tensor, "rows dof"], sigma: float) -> Float64[Tensor, " rows"] | None:
    return torch.full((len(q),), sigma, dtype=q.dtype, device=q.device) if sigma else None


def kind(section: object) -> object:
    """Tell a section by its kind, which a tracker need not state."""
    return section.get("kind", "tracker") if isinstance(section, dict) else getattr(section, "kind", None)


SimulatedPoses = Annotated[
    Annotated[SimulatedMeasurements, Tag("tracker")] | Annotated[SimulatedImages, Tag("images")],
    Discriminator(kind),
]
"""What measures poses: a tracker, unless the kind images is stated."""

SimulatedSensor = Annotated[
    SimulatedMeasurements | SimulatedTouches | SimulatedSockets | SimulatedDistances | SimulatedPairs,
    Field(discriminator="kind"),
]
"""What one sensor measures, told apart by `kind`: tracker, touches, sockets, distances or pairs."""


class SimulatedSensors(Section):
    """The part of a recipe that states what several sensors measure on the same true robot.

    Attributes:
        sensors: one or more; their rows follow each other.
    """

    sensors: tuple[SimulatedSensor, ...] = Field(min_length=1)

    def measure(self, robot: TrueRobot) -> Measurements:
        """Simulate all sensors and join their rows, the same at every call. See `pisigma.measurement.join`."""
        return join([sensor.measure(robot) for sensor in self.sensors])
