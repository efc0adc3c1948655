"""Checks of rows against a model or a robot, one file each, before anything is concluded from them."""
