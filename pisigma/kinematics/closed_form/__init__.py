"""Inverse kinematics in closed form, all branches, for the three families of robots that have one here."""

from pisigma.kinematics.closed_form.choice import closed_form_solver
from pisigma.kinematics.closed_form.interface import AbstractClosedForm, InverseSolutions

__all__ = ["AbstractClosedForm", "InverseSolutions", "closed_form_solver"]
