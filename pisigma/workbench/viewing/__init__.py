"""Three-dimensional view of a measuring session in the browser: robot, cell, rows, errors and accuracy (viser)."""
