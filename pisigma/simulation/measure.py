"""Simulated measurements of the true robot by a tracker or by several sensors."""

from dataclasses import replace
from typing import Annotated, Literal

import torch
from jaxtyping import Float64
from pydantic import Discriminator, Field, Tag
from torch import Tensor

from pisigma.files.yaml_file import Section
from pisigma.measurement.dataset import Measurements, join
from pisigma.simulation.camera.simulated_images import SimulatedImages
from pisigma.simulation.commanded import AbstractCommandedJoints
from pisigma.simulation.distances import SimulatedDistances, SimulatedPairs, SimulatedSockets
from pisigma.simulation.noise import MeasurementNoise
from pisigma.simulation.touching import SimulatedTouches
from pisigma.simulation.true_robot import TrueRobot


class SimulatedTracker(AbstractCommandedJoints):
    """Section of a recipe for a tracker that measures the true robot.

    Attributes:
        poses: desired poses, or joint values to command.
        branch: branch of the inverse kinematics for desired poses; not for joint values.
        kind: "tracker", the default.
        sensor: "pose" (position and orientation) or "position".
        noise: noise of the sensor; no noise by default.
        frame: name of the tracker's frame, which is the robot's base frame.
        target: name of the measured target on the robot.
    """

    kind: Literal["tracker"] = "tracker"
    sensor: Literal["pose", "position"] = "pose"
    noise: MeasurementNoise | None = None
    frame: str = ""
    target: str = ""

    def measure(self, robot: TrueRobot) -> Measurements:
        """Return simulated measurements, identical for every call; see `simulate`."""
        measured = simulate(robot, self.commanded_joints(robot), self.sensor, self.noise)
        rows = measured.rows
        return replace(measured, frame=(self.frame,) * rows, target=(self.target,) * rows)


def simulate(
    robot: TrueRobot,
    q: Float64[Tensor, "rows dof"],
    sensor: Literal["pose", "position"] = "pose",
    noise: MeasurementNoise | None = None,
) -> Measurements:
    """Command joint values and measure the tool poses of the true robot.

    Args:
        robot: the true robot.
        q: commanded joint values [rad or m], with the sign and zero of the controller.
        sensor: "pose" to measure orientations in addition to positions. The sensor's frame is the robot's base frame.
        noise: noise of the sensor; None for exact measurements.

    Returns:
        One row per commanded joint vector, with the standard deviations of the noise, if any, and with random
        directions of approach if joints have backlash.

    Raises:
        PoseError: the number of columns of q is not the robot's number of joints.
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
    """Return the kind of a section; "tracker" if it states none."""
    return section.get("kind", "tracker") if isinstance(section, dict) else getattr(section, "kind", None)


SimulatedPoses = Annotated[
    Annotated[SimulatedTracker, Tag("tracker")] | Annotated[SimulatedImages, Tag("images")],
    Discriminator(kind),
]
"""Section of a sensor that measures poses: a tracker (default) or images."""

SimulatedSensor = Annotated[
    SimulatedTracker | SimulatedTouches | SimulatedSockets | SimulatedDistances | SimulatedPairs,
    Field(discriminator="kind"),
]
"""Section of a sensor, distinguished by `kind`: tracker, touches, sockets, distances or pairs."""


class SimulatedSensors(Section):
    """Section of a recipe for several sensors that measure the same true robot.

    Attributes:
        sensors: one or more sensors, whose rows are concatenated.
    """

    sensors: tuple[SimulatedSensor, ...] = Field(min_length=1)

    def measure(self, robot: TrueRobot) -> Measurements:
        """Return the rows of all sensors, identical for every call and joined by `pisigma.measurement.join`."""
        return join([sensor.measure(robot) for sensor in self.sensors])
