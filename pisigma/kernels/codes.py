"""Numbers by which the kernels and those who call them understand each other."""

from pisigma.kinematics.status import Status

REACHED = int(Status.REACHED)
SINGULAR = int(Status.SINGULAR)
OUTSIDE_LIMITS = int(Status.OUTSIDE_JOINT_LIMITS)
OUTSIDE_DOMAIN = int(Status.OUTSIDE_DOMAIN)
UNREACHABLE = int(Status.UNREACHABLE)
INVALID = int(Status.INVALID_POSE)

SINGULAR_TOLERANCE = 1e-5
"""A solution is SINGULAR where the smallest singular value is smaller: see `kinematics.numeric`."""

FINE, NOT_FINITE, LAST_ROW, NOT_ORTHONORMAL, LEFT_HANDED, NEAR_NOT_FINITE = -1, 1, 2, 3, 4, 5
"""What is wrong with a matrix that should be a pose, or with the joint values to be near to."""

ANY_BRANCH, EVERY_BRANCH = -1, -2
"""Instead of the index of a branch."""

SOLVE, EVALUATE = 0, 1
"""What the kernels are to do."""
