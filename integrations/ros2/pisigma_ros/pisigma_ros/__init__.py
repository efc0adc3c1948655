"""Corrected joint values of a calibrated robot in ROS 2."""
