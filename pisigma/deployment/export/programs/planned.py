"""Programs that move to planned poses, via waypoints around obstacles, and stop at every pose for a measurement."""

from pathlib import Path

import torch

from pisigma import __version__
from pisigma.deployment.export.programs.languages import COUNTING, LANGUAGES, Program, check_program
from pisigma.planning.plan_file import StoredPlan

TEST = (
    "TEST IT AT LOW SPEED FIRST: the poses and the motions between them keep the joint limits, and the arm touches "
    "neither itself nor the stated obstacles. Nothing else was checked, not even the motion to the first pose."
)


def planned_program(plan: StoredPlan, path: Path) -> str:
    """Write the program that moves to all poses of a plan and waits for a measurement at each pose.

    Args:
        plan: plan of a robot with six revolute joints.
        path: file to write; its suffix determines the language, its stem is the name of the program.

    Raises:
        OutputError: the program cannot be written to this file.
    """
    robot = plan.arm.robot
    check_program(path, robot, False, None)
    language = LANGUAGES[path.suffix.lower()]
    q, labels, waits = [], [], []
    for order, pose, points in zip(plan.numbers, plan.q, plan.waypoints, strict=True):
        q += [*points, pose]
        labels += ["waypoint"] * len(points) + [f"pose {order}"]
        waits += [0.0] * len(points) + [plan.settings.settling_s]
    title = f"{len(plan.q)} planned poses of robot {robot.name}, by pisigma {__version__}."
    heading = [title, TEST, COUNTING.format(robot=robot.name)]
    program = Program(
        language.program_name(path),
        robot,
        heading,
        robot.to_controller(torch.stack(q)),
        tuple(labels),
        tuple(waits),
    )
    return language.write(program)
