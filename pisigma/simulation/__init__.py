"""Simulation: error sources of a true robot, and what sensors would measure on it."""

from pisigma.simulation.commanded import BranchSection, joints_for_poses
from pisigma.simulation.distances import (
    AnchorSection,
    SimulatedDistances,
    SimulatedPairs,
    SimulatedSockets,
    SocketSection,
)
from pisigma.simulation.measure import SimulatedMeasurements, SimulatedSensor, SimulatedSensors, simulate
from pisigma.simulation.noise import MeasurementNoise, SensorNoise
from pisigma.simulation.poses import WhereToMeasure
from pisigma.simulation.touch_candidates import JigPlacement, TouchCandidates, TouchCandidatesSection
from pisigma.simulation.touching import SimulatedTouches, simulate_touches
from pisigma.simulation.true_robot import ErrorSource, TrueRobot, TrueRobotSection, register_error_source

__all__ = [
    "AnchorSection",
    "BranchSection",
    "ErrorSource",
    "JigPlacement",
    "MeasurementNoise",
    "SensorNoise",
    "SimulatedDistances",
    "SimulatedMeasurements",
    "SimulatedPairs",
    "SimulatedSensor",
    "SimulatedSensors",
    "SimulatedSockets",
    "SimulatedTouches",
    "SocketSection",
    "TouchCandidates",
    "TouchCandidatesSection",
    "TrueRobot",
    "TrueRobotSection",
    "WhereToMeasure",
    "joints_for_poses",
    "register_error_source",
    "simulate",
    "simulate_touches",
]
