"""A measuring session in the browser: robot, cell, rows, errors and accuracy in three dimensions, through viser."""
