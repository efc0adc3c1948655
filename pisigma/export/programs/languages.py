"""The registry of controllers' languages, and the program for a file by its ending."""

import re
from pathlib import Path

import torch

from pisigma.errors import OutputError
from pisigma.export.programs.language import Language, Program
from pisigma.export.programs.targets import Targets
from pisigma.robot.description import Robot


def words(text: str) -> frozenset[str]:
    """Words of a language in capitals, for `Language.reserved`."""
    return frozenset(text.upper().split())


FILES_OF_SYSTEMS = words("con prn aux nul") | {f"{p}{i}" for p in ("COM", "LPT") for i in range(1, 10)}
"""Names that some controllers' file systems keep for devices."""

URSCRIPT = Language(
    name="URScript",
    template="urscript.j2",
    longest=64,
    reserved=words(
        "and break continue def elif else end enum false for global halt if local not or pass return run sec "
        "struct then thread true while xor movej get_inverse_kin pose_trans set_tcp p speed acceleration frame"
    ),
    line_end="\n",
    keeps_branch=True,
    cartesian_cautions=(
        "The controller computes poses with the lengths of its factory calibration where it has one, not with the "
        "robot as drawn; joint targets do not depend on that.",
    ),
)
KRL = Language(
    name="KRL",
    template="krl.j2",
    longest=24,
    reserved=FILES_OF_SYSTEMS
    | words(
        "and anin anout b_and b_exor b_not b_or bool brake bas case ccomp channel char circ circ_rel confirm "
        "const continue ct_i decl def default defdat deffct digin do else end enddat endfct endfor endif "
        "endloop endspline endswitch endwhile enum exit exor ext extfct false for frame global goto halt if "
        "import int interrupt is lin lin_rel loop maximum minimum not or pos e6pos axis e6axis priority ptp "
        "ptp_rel public pulse real repeat resume return sec signal slin spl spline spo sptp step struc "
        "switch then to trigger true until wait when while speed i"
    ),
)
RAPID = Language(
    name="RAPID",
    template="rapid.j2",
    longest=27,  # of 32, with _tool behind it
    reserved=words(
        "alias and backward bool case connect const default div do else elseif endfor endfunc endif endmodule endproc "
        "endrecord endtest endtrap endwhile error exit false for from func goto if inout local mod module nostepin not "
        "noview num or pers proc raise readonly record retry return step string sysmodule task test then to trap true "
        "trynext undo user var viewonly while with xor slow fine tool0 wobj0 movej moveabsj confj base"
    ),
)
FANUC = Language(
    name="FANUC",
    template="fanuc.j2",
    longest=36,
    reserved=FILES_OF_SYSTEMS,
    most_lines=9999,
    capitals=True,
    configuration=re.compile(r"[NF] ([LR] )?[UD] [TB], -?\d, -?\d, -?\d"),
    cautions=(
        "On FANUC pendants J3 counts from the horizontal, so it changes with J2. The values here count as the joint "
        "values of the model's measurements did; where those were angles between links, J3 has to be converted.",
    ),
    cartesian_cautions=(
        "UFRAME counts from the world frame, which on FANUC robots lies at the height of J2.",
    ),
)

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
    if cartesian and language.configuration:
        _check_turns(targets)
    return language.write(Program(targets, language.program_name(path), cartesian, config or ""))


def _check_turns(targets: Targets) -> None:
    """Refuse joint values that lie on several turns, as one configuration names one turn for all."""
    turns = torch.floor(targets.q / (2 * torch.pi) + 0.5)
    if len(turns) and bool((turns != turns[0]).any()):
        row = int((turns != turns[0]).any(-1).nonzero()[0, 0])
        raise OutputError(
            f"{targets.source}, line {targets.line[row]}: a joint stands on another turn than in line "
            f"{targets.line[0]}, so one --config does not fit both; take --targets joints or write two programs."
        )
