"""Backlash, by which joints stop on the side of their play from which they approach."""

from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from pisigma.files.yaml_file import Seed
from pisigma.robot.description import Robot
from pisigma.simulation.errors.source import AbstractPlaySource, value_per_joint


class Backlash(AbstractPlaySource):
    """Backlash by which every joint stops short by half of its play: `e_j = -play_j / 2 · approach_j`.

    The approach is +1 if the joint's value increased before it stopped and -1 if it decreased. For
    simulated trackers and distance sensors, the approach direction of every joint is drawn at random for every row and
    written to the measurements. Touches and sockets are approached until they fit, so the joints are in the middle of
    the play.

    Source: Whitney, Lozinski and Rourke, "Industrial robot forward calibration method and results", ASME
    Journal of Dynamic Systems, Measurement, and Control 108(1), 1986, 1-8.

    Attributes:
        kind: "backlash".
        play_deg: full play by name of a revolute joint [deg]; an arc minute is 0.0167.
        play_mm: full play by name of a prismatic joint [mm].
        seed: random seed of the directions of approach.
    """

    kind: Literal["backlash"]
    play_deg: dict[str, Annotated[float, Field(ge=0)]] = Field(default_factory=dict)
    play_mm: dict[str, Annotated[float, Field(ge=0)]] = Field(default_factory=dict)
    seed: Seed = 0

    def half_play(self, robot: Robot, place_in_recipe: str) -> Float64[np.ndarray, " dof"]:
        """Return half the play of every joint [rad or m]; see `AbstractPlaySource.half_play`."""
        stated = value_per_joint(robot, self.play_deg, self.play_mm, ("play_deg", "play_mm"), place_in_recipe)
        return np.where(robot.revolute, np.deg2rad(stated), stated / 1e3) / 2
