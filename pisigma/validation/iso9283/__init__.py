"""Performance criteria of ISO 9283:1998: poses, distances, drift, paths, and the cube to measure them in.

Tensors are `(*batch, n, 3)`: n repeats of a command, at x, y, z [m] or turned by a, b, c [rad]. What is said of angles
holds for any three that are small or unique: roll, pitch and yaw, or the components of a rotation vector.
"""
