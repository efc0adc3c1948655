"""Simulation: error sources of a true robot, and what sensors would measure on it."""

from pisigma.simulation.branch import BranchSection
from pisigma.simulation.commanded import joints_for_poses
from pisigma.simulation.distances import AnchorSection, SimulatedDistances, SimulatedPairs
from pisigma.simulation.jig_placement import JigPlacement
from pisigma.simulation.measure import SimulatedMeasurements, simulate
from pisigma.simulation.noise import MeasurementNoise
from pisigma.simulation.parts import SimulatedParts, SimulatedSensor
from pisigma.simulation.poses import WhereToMeasure
from pisigma.simulation.sensor_noise import SensorNoise
from pisigma.simulation.sockets import SimulatedSockets, SocketSection
from pisigma.simulation.touch_candidates import TouchCandidates, TouchCandidatesSection
from pisigma.simulation.touching import SimulatedTouches, simulate_touches
from pisigma.simulation.true_robot import ErrorSource, TrueRobot, TrueRobotSection

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
    "SimulatedParts",
    "SimulatedSensor",
    "SimulatedSockets",
    "SimulatedTouches",
    "SocketSection",
    "TouchCandidates",
    "TouchCandidatesSection",
    "TrueRobot",
    "TrueRobotSection",
    "WhereToMeasure",
    "joints_for_poses",
    "simulate",
    "simulate_touches",
]
