"""What stands at the head of every program."""

from pisigma.export.programs.targets import Targets

TEST = (
    "TEST IT AT LOW SPEED FIRST: nothing was checked for collisions, neither the targets nor the ways between "
    "them."
)


def heading(targets: Targets, cartesian: bool) -> tuple[str, ...]:
    """Sentences on what the program does and on what it relies.

    Args:
        targets: the targets.
        cartesian: whether they are poses and not joint values.
    """
    said = [
        targets.title,
        TEST,
        f"Joint values count from the zeros and in the directions of the robot description "
        f"'{targets.robot.name}'; the controller has to count the same.",
    ]
    if cartesian:
        said += [
            "Poses are those that the robot as drawn takes at the corrected joint values: the controller has to "
            "compute with the robot as drawn, and any accuracy option of its own has to be off.",
            "Frame and tool are those of the model, as seen from the origin and from the last row of the robot "
            "description, which have to be the controller's origin and flange.",
            *targets.remarks,
        ]
    if targets.doubt:
        said.append(targets.doubt)
    return tuple(said)
