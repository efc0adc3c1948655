"""Corrected inverse kinematics as a shared library for C."""
