"""Cameras and printed boards: from pixels of corners to camera poses for the calibration of a robot."""
