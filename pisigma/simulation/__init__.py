"""Simulation: error sources of a true robot, and what a sensor would measure on it."""

from pisigma.simulation.branch import BranchSection
from pisigma.simulation.measure import SimulatedMeasurements, joints_for_poses, simulate
from pisigma.simulation.noise import MeasurementNoise
from pisigma.simulation.poses import WhereToMeasure
from pisigma.simulation.true_robot import ErrorSource, TrueRobot, TrueRobotSection

__all__ = [
    "BranchSection",
    "ErrorSource",
    "MeasurementNoise",
    "SimulatedMeasurements",
    "TrueRobot",
    "TrueRobotSection",
    "WhereToMeasure",
    "joints_for_poses",
    "simulate",
]
