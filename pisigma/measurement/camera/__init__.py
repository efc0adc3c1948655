"""Cameras and printed boards: from the pixels of corners to poses for the calibration of a robot."""
