"""Cameras as error-prone sensors: which images they take of a board."""
