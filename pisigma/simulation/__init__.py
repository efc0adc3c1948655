"""Simulation of a true robot with error sources, and of sensors that measure it."""

from pisigma.simulation.distances import SimulatedDistances, SimulatedPairs, SimulatedSockets
from pisigma.simulation.measure import SimulatedSensors, SimulatedTracker, simulate
from pisigma.simulation.touch_candidates import JigPlacement, TouchCandidatesSection
from pisigma.simulation.touching import SimulatedTouches, simulate_touches
from pisigma.simulation.true_robot import TrueRobot, TrueRobotSection, register_error_source

__all__ = [
    "JigPlacement",
    "SimulatedDistances",
    "SimulatedPairs",
    "SimulatedSensors",
    "SimulatedSockets",
    "SimulatedTouches",
    "SimulatedTracker",
    "TouchCandidatesSection",
    "TrueRobot",
    "TrueRobotSection",
    "register_error_source",
    "simulate",
    "simulate_touches",
]
