"""Surroundings of a robot: which poses and motions are collision-free, and which poses are visible."""
