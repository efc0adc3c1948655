"""What became of a wanted pose, as a number that fits in a tensor and a sentence that a person can act on."""

import enum


class Status(enum.IntEnum):
    """Outcome of inverse kinematics for one pose and one branch.

    Joint values are NaN where, and only where, the status is UNREACHABLE or INVALID_POSE. Where several apply, the
    gravest counts, in the order REACHED, OUTSIDE_DOMAIN, SINGULAR, OUTSIDE_JOINT_LIMITS, then NOT_CONVERGED or
    UNREACHABLE: a singular pose is never hidden, and the domain is seen in its measure too.
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
        """What the status means and what to do about it."""
        return _SENTENCES[self]

    @property
    def reaches(self) -> bool:
        """Whether the joint values given with this status take the tool to the pose, limits aside."""
        return self not in (Status.UNREACHABLE, Status.NOT_CONVERGED, Status.INVALID_POSE)


_SENTENCES = {
    Status.REACHED: "The joint values reach the pose and lie within the joint limits.",
    Status.SINGULAR: (
        "The joint values reach the pose, but it is singular: a joint that is not determined there is given "
        "as 0, and small moves of the tool need large moves of joints; choose another pose or branch, or go "
        "through it by joint moves."
    ),
    Status.OUTSIDE_JOINT_LIMITS: (
        "The joint values would reach the pose, but at least one lies outside the joint limits; choose "
        "another branch or pose."
    ),
    Status.OUTSIDE_DOMAIN: (
        "The joint values reach the pose, but lie outside the region that the measurements covered, so the correction "
        "there is extrapolated; look at the predicted accuracy, or measure there too."
    ),
    Status.UNREACHABLE: (
        "No joint values reach the pose, in position and orientation, on this branch, or none were found; choose "
        "another branch, ignore axes of the tool that the task leaves free or give them tolerances, or move the pose."
    ),
    Status.NOT_CONVERGED: (
        "The search stopped before it reached the pose, and the joint values given do not reach it; start "
        "nearer, or check that the pose lies in the workspace."
    ),
    Status.INVALID_POSE: (
        "The matrix is no pose (not finite, no rotation, or no last row 0 0 0 1), or the joint values to be near "
        "to are not finite; correct it."
    ),
}
