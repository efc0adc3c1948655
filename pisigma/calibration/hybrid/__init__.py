"""Hybrid calibration: geometry and a Pi-Sigma joint correction, fitted together through the kinematics."""
