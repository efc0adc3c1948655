"""Status of an inverse kinematics solution: a number that fits in a tensor, and a sentence with advice for users."""

import enum


class Status(enum.IntEnum):
    """Status of inverse kinematics for one pose and one branch.

    Joint values are NaN if and only if the status is UNREACHABLE or INVALID_POSE. If several apply, the most severe is
    returned, in the order REACHED, OUTSIDE_DOMAIN, SINGULAR, OUTSIDE_JOINT_LIMITS, NOT_CONVERGED or UNREACHABLE, so
    that a singular pose is never hidden; the domain also has a separate measure.
    """

    REACHED = 0
    SINGULAR = 1
    OUTSIDE_JOINT_LIMITS = 2
    OUTSIDE_DOMAIN = 3
    UNREACHABLE = 4
    NOT_CONVERGED = 5
    INVALID_POSE = 6

    @property
    def sentence(self) -> str:
        """Meaning of the status, and what to do about it."""
        return _SENTENCES[self]

    @property
    def reaches(self) -> bool:
        """Whether joint values with this status reach the pose, regardless of limits."""
        return self not in (Status.UNREACHABLE, Status.NOT_CONVERGED, Status.INVALID_POSE)


_SENTENCES = {
    Status.REACHED: "The joint values reach the pose and are within the joint limits.",
    Status.SINGULAR: (
        "The joint values reach the pose, but it is singular: joints that it does not determine are set to 0, and "
        "small tool motions require large joint motions; choose another pose or branch, or pass it with joint moves."
    ),
    Status.OUTSIDE_JOINT_LIMITS: (
        "The joint values would reach the pose, but at least one is outside the joint limits; choose another branch or "
        "pose."
    ),
    Status.OUTSIDE_DOMAIN: (
        "The joint values reach the pose, but are outside the region of the measurements, so the correction is "
        "extrapolated; check the predicted accuracy, or measure there too."
    ),
    Status.UNREACHABLE: (
        "No joint values on this branch reach the position and orientation, or none were found; choose another branch, "
        "ignore tool axes that the task leaves free or give them tolerances, or move the pose."
    ),
    Status.NOT_CONVERGED: (
        "The iteration stopped before it reached the pose, and the joint values returned do not reach it; use a nearer "
        "start, or check that the pose is in the workspace."
    ),
    Status.INVALID_POSE: (
        "The matrix is not a valid pose (entries are not finite, the rotation is invalid, or the last row is not 0 0 0 "
        "1), or the reference joint values are not finite; correct it."
    ),
}
