"""Cameras and printed boards: from pixels of corners to poses of the camera that a robot is calibrated with."""
