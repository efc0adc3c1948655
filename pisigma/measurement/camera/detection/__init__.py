"""Detect corners of printed boards in images with OpenCV (the extra `camera`)."""
