"""Simulated cameras: images of a board on a true robot."""
