"""Simulated images of a board, taken by cameras on a true robot."""
