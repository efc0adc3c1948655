"""Hybrid calibration: geometry and a Pi-Sigma joint correction that are fitted together through the kinematics."""
