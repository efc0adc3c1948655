"""Small calibrations of a base, tool or hand-eye transform, with the arm of a robot, model or cell held fixed."""
