"""Closed-form inverse kinematics with all branches for families of robots, and their registry."""

from pisigma.robot.kinematics.closed_form.interface import AbstractClosedForm, InverseSolutions
from pisigma.robot.kinematics.closed_form.registry import closed_form_solver, register_closed_form

__all__ = ["AbstractClosedForm", "InverseSolutions", "closed_form_solver", "register_closed_form"]
