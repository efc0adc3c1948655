"""Performance criteria of ISO 9283:1998 for poses, distances, drift and paths, and the test cube.

Tensors are `(*batch, n, 3)`: n repeats of a command, with positions x, y, z [m] or angles a, b, c [rad]. Any three
angles that are small or unique can be used: roll, pitch and yaw, or the components of a rotation vector.
"""
