"""Robots with coupled joints, invented for tests."""

from pisigma.files.errors import RobotError
from pisigma.files.yaml_file import parse_yaml
from pisigma.robot import Robot, RobotDocument

COUPLED = """\
name: coupled
maker: nobody
source: made up
rows:
  - {name: theta_1, type: revolute, limits_deg: [-185, 185], d_mm: 670, a_mm: 312, alpha_deg: -90}
  - {name: theta_2, type: revolute, limits_deg: [-60, 76], theta_deg: -90, a_mm: 1075}
  - {name: theta_3, type: revolute, direction: -1, limits_deg: [-132, 220], a_mm: 225, alpha_deg: -90}
  - {name: theta_4, type: revolute, direction: -1, limits_deg: [-360, 360], d_mm: 1280, alpha_deg: 90}
  - {name: theta_5, type: revolute, direction: -1, limits_deg: [-125, 125], alpha_deg: -90}
  - {name: theta_6, type: revolute, direction: -1, limits_deg: [-360, 360], d_mm: 215}
coupling:
  - {joint: theta_3, factors: {theta_2: 1, theta_3: 1}}
"""
"""Six joints, the third of which is measured from the horizontal."""

PALLETISER = """\
name: palletiser
maker: nobody
source: made up
rows:
  - {name: theta_1, type: revolute, limits_deg: [-165, 165], d_mm: 742, a_mm: 260, alpha_deg: -90}
  - {name: theta_2, type: revolute, limits_deg: [-40, 85], theta_deg: -90, a_mm: 945}
  - {name: theta_3, type: revolute, limits_deg: [-20, 120], theta_deg: 90, a_mm: 1025}
  - {name: tilt, type: revolute, a_mm: 220, alpha_deg: -90}
  - {name: theta_4, type: revolute, limits_deg: [-300, 300], d_mm: 225, alpha_deg: 180}
coupling:
  - joint: theta_3
    factors: {theta_3: 1, theta_2: -1}
    limits_deg: [-65, 65]
    four_bar: {ground_mm: 945, crank_mm: 400, coupler_mm: 945.4, rocker_mm: 400.2, zero_deg: 90}
  - {joint: tilt, factors: {theta_3: -1}}
"""
"""Four axes: two motors on the base move upper arm and, by a parallelogram, forearm; rods keep the flange level."""


def coupled_robot(text: str = COUPLED) -> Robot:
    """Load one of the robots."""
    return Robot(*parse_yaml(text, RobotDocument, RobotError, "robot.yaml").to_fields())
