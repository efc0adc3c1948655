"""The registry of controllers' languages, and the program for a file by its ending."""

from pathlib import Path

from pisigma.errors import OutputError
from pisigma.export.programs.fanuc_ls import FANUC
from pisigma.export.programs.krl import KRL
from pisigma.export.programs.language import Program
from pisigma.export.programs.rapid import RAPID
from pisigma.export.programs.targets import Targets
from pisigma.export.programs.urscript import URSCRIPT
from pisigma.robot.description import Robot

LANGUAGES = {".script": URSCRIPT, ".src": KRL, ".mod": RAPID, ".ls": FANUC}
"""By the suffix of the file."""


def check_program(path: Path, robot: Robot, cartesian: bool, config: str | None) -> None:
    """Make sure that a program can be written, before the targets are computed.

    Raises:
        OutputError: the name of the file, the robot or the options do not do.
    """
    language = LANGUAGES[path.suffix.lower()]
    language.program_name(path)
    if robot.dof != 6 or not all(robot.revolute):
        turning = sum(robot.revolute)
        raise OutputError(
            f"{path}: {language.name} programs are written for robots with six joints that turn; robot "
            f"'{robot.name}' has {turning} that turn and {robot.dof - turning} that slide. Take a .csv file."
        )
    needed = language.configuration if cartesian else None
    if needed is None:
        if config is not None:
            endings = " or ".join(suffix for suffix, other in LANGUAGES.items() if other.configuration)
            raise OutputError(f"--config goes with a {endings} file and --targets cartesian; leave it out.")
    elif config is None:
        raise OutputError(
            f"{path}: {language.name}'s Cartesian targets need the arm's configuration, which pisigma does not know; "
            "give it as the pendant shows it, such as --config 'N U T, 0, 0, 0', or take --targets joints."
        )
    elif not needed.fullmatch(config):
        raise OutputError(f"--config '{config}': one such as 'N U T, 0, 0, 0' was wanted.")


def cautions(path: Path, cartesian: bool) -> tuple[str, ...]:
    """What has to be known before a program is used, besides what is true of all of them."""
    language = LANGUAGES[path.suffix.lower()]
    return (*language.cautions, *(language.cartesian_cautions if cartesian else ()))


def program_text(targets: Targets, path: Path, cartesian: bool, config: str | None = None) -> str:
    """The program for a file.

    Args:
        targets: the targets.
        path: the file; its suffix is one of `LANGUAGES`, its name is the program's.
        cartesian: write poses instead of joint values.
        config: configuration of all poses, where the language wants one.

    Raises:
        OutputError: the program cannot be written so.
        UnreachablePoseError: a pose has no target; the message names line and status.
    """
    check_program(path, targets.robot, cartesian, config)
    targets.check_complete()
    language = LANGUAGES[path.suffix.lower()]
    if cartesian and not language.keeps_branch and len(set(targets.branch)) > 1:
        other = next(row for row, name in enumerate(targets.branch) if name != targets.branch[0])
        raise OutputError(
            f"{targets.source}, line {targets.line[other]}: the target lies on branch {targets.branch[other]}, "
            f"that of line {targets.line[0]} on branch {targets.branch[0]}, which a {language.name} program of "
            "poses cannot tell apart; take --targets joints or one --branch."
        )
    return language.write(Program(targets, language.program_name(path), cartesian, config or ""))
