"""Checks of rows against a model or a robot, one file each, before the rows are used for anything."""
