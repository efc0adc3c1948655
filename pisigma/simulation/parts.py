"""Simulated measurements of several sensors as one data set."""

from typing import Annotated

from pydantic import Field

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.joining import join
from pisigma.simulation.distances import SimulatedDistances, SimulatedPairs
from pisigma.simulation.measure import SimulatedMeasurements
from pisigma.simulation.sockets import SimulatedSockets
from pisigma.simulation.touching import SimulatedTouches
from pisigma.simulation.true_robot import TrueRobot
from pisigma.yaml_file import Section

SimulatedSensor = Annotated[
    SimulatedMeasurements | SimulatedTouches | SimulatedSockets | SimulatedDistances | SimulatedPairs,
    Field(discriminator="kind"),
]
"""What one sensor measures, told apart by `kind`: tracker, touches, sockets, distances or pairs."""


class SimulatedParts(Section):
    """The part of a recipe that states what several sensors measure on the same true robot.

    Attributes:
        parts: one or more; their rows follow each other.
    """

    parts: tuple[SimulatedSensor, ...] = Field(min_length=1)

    def measure(self, robot: TrueRobot) -> Measurements:
        """Simulate all parts and join them, the same at every call. See `pisigma.measurement.join`."""
        return join([part.measure(robot) for part in self.parts])
