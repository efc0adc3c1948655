"""Corrected inverse kinematics of a calibrated model."""
