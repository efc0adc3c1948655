"""Surroundings of a robot, which decide which poses and motions are collision-free and which poses are visible."""
