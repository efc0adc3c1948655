"""Controllers' languages: how programs are named and written, what they cannot hold, and the program for a file."""

import functools
import re
from dataclasses import dataclass
from pathlib import Path

import jinja2
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.deployment.export.programs.targets import Targets
from pisigma.deployment.export.programs.text import (
    comments,
    labelled,
    metres_and_rotation_vector,
    millimetres,
    millimetres_and_euler,
    numbers,
    quaternion,
)
from pisigma.files.errors import OutputError
from pisigma.files.templates import template_environment
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.status import Status

TEST = "TEST IT AT LOW SPEED FIRST: nothing was checked for collisions, neither the targets nor the ways between them."
COUNTING = (
    "Joint values count from the zeros and in the directions of the robot description '{robot}'; the controller has to "
    "count the same."
)
CARTESIAN = (
    "Poses are those that the robot as drawn takes at the corrected joint values: the controller has to compute with "
    "the robot as drawn, and any accuracy option of its own has to be off.",
    "Frame and tool are those of the model, as seen from the origin and from the last row of the robot description, "
    "which have to be the controller's origin and flange.",
)


@dataclass(frozen=True, eq=False)
class Program:
    """What a program is to hold: stops of a robot with six joints that turn.

    Attributes:
        name: of the program.
        robot: as drawn.
        heading: sentences on what the program does and on what it relies.
        q: joint values of every stop [rad].
        labels: what is said before the move to every stop.
        waits: how long the robot waits at every stop [s]; 0 for not at all.
        cartesian: the targets, where it holds poses instead of joint values; else None.
        config: configuration of the arm in all poses, where the language wants one; else "".
    """

    name: str
    robot: Robot
    heading: list[str]
    q: Float64[Tensor, "stops 6"]
    labels: tuple[str, ...]
    waits: tuple[float, ...]
    cartesian: Targets | None = None
    config: str = ""

    @staticmethod
    def of_targets(targets: Targets, name: str, cartesian: bool, config: str = "") -> "Program":
        """Give the program that goes to targets, of which none is missing."""
        said = [targets.title, TEST, COUNTING.format(robot=targets.robot.name)]
        said += [*CARTESIAN, *targets.remarks] if cartesian else []
        said += [targets.doubt] if targets.doubt else []
        labels = [
            f"line {line}{' OUTSIDE DOMAIN' if status == Status.OUTSIDE_DOMAIN else ''}"
            for line, status in zip(targets.line, targets.status, strict=True)
        ]
        waits = (0.0,) * len(labels)
        shown = targets if cartesian else None
        return Program(name, targets.robot, said, targets.q, tuple(labels), waits, shown, config)

    @property
    def degrees(self) -> list[list[float]]:
        """Joint values of every stop [deg]."""
        degrees: list[list[float]] = torch.rad2deg(self.q).tolist()
        return degrees


@dataclass(frozen=True)
class Language:
    """One language.

    Attributes:
        name: of the language.
        template: the file of the folder `templates` that lays its programs out.
        longest: characters that a program's name may have.
        reserved: words of the language that may be no name, in capitals.
        line_end: what its lines end with.
        most_lines: numbered lines that a program may have; None for any number.
        keeps_branch: whether Cartesian targets may lie on several branches.
        capitals: whether names are written in capitals.
        configuration: what the arm's configuration looks like, where Cartesian targets need one.
        cautions: what has to be known before a program is used, besides what is true of all languages.
        cartesian_cautions: the same of Cartesian targets.
    """

    name: str
    template: str
    longest: int
    reserved: frozenset[str]
    line_end: str = "\r\n"
    most_lines: int | None = None
    keeps_branch: bool = False
    capitals: bool = False
    configuration: re.Pattern[str] | None = None
    cautions: tuple[str, ...] = ()
    cartesian_cautions: tuple[str, ...] = ()

    def program_name(self, path: Path) -> str:
        """The program's name, which is that of its file.

        Raises:
            OutputError: the language has no such names; the message proposes one that it has.
        """
        stem = path.stem.upper() if self.capitals else path.stem
        fits = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", stem, re.ASCII) and len(stem) <= self.longest
        if fits and stem.upper() not in self.reserved:
            return stem
        other = re.sub(r"[^A-Za-z0-9]+", "_", stem).strip("_")
        other = other if other[:1].isalpha() else f"P{'_' if other else ''}{other}"
        other = f"P_{other}" if other.upper() in self.reserved else other
        raise OutputError(
            f"{path}: the program is called as its file, and {self.name} takes names of letters, digits and _ "
            f"that begin with a letter, have at most {self.longest} characters and are no word of its own; "
            f"choose another --out, such as {other[: self.longest].rstrip('_')}{path.suffix}."
        )

    def write(self, program: Program) -> str:
        """The text of a program.

        Raises:
            OutputError: it has more lines than the language takes.
        """
        said = [*self.cautions, *(self.cartesian_cautions if program.cartesian else ())]
        content = {"program": program, "targets": program.cartesian, "cautions": said}
        text = _templates().get_template(self.template).render(content) + "\n"
        lines = len(_NUMBERED_LINE.findall(text))
        if self.most_lines is not None and lines > self.most_lines:
            raise OutputError(
                f"the program {program.name} would have {lines} lines, of which a {self.name} controller takes "
                f"{self.most_lines}; split the file of poses."
            )
        return text.replace("\n", self.line_end)


_NUMBERED_LINE = re.compile(r"(?m)^ *\d+:")


@functools.cache
def _templates() -> jinja2.Environment:
    filters = (
        numbers,
        labelled,
        comments,
        millimetres,
        millimetres_and_euler,
        metres_and_rotation_vector,
        quaternion,
    )
    return template_environment(
        "pisigma.deployment.export.programs", {filter.__name__: filter for filter in filters}
    )


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
    turning = sum(axis.type == "revolute" for axis in robot.axes)
    if len(robot.axes) != 6 or turning != 6:
        raise OutputError(
            f"{path}: {language.name} programs are written for robots with six joints that turn; robot "
            f"'{robot.name}' has {turning} that turn and {len(robot.axes) - turning} that slide. Take a .csv file."
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
    return language.write(Program.of_targets(targets, language.program_name(path), cartesian, config or ""))


def _check_turns(targets: Targets) -> None:
    """Refuse joint values that lie on several turns, as one configuration names one turn for all."""
    turns = torch.floor(targets.q / (2 * torch.pi) + 0.5)
    if len(turns) and bool((turns != turns[0]).any()):
        row = int((turns != turns[0]).any(-1).nonzero()[0, 0])
        raise OutputError(
            f"{targets.source}, line {targets.line[row]}: a joint stands on another turn than in line "
            f"{targets.line[0]}, so one --config does not fit both; take --targets joints or write two programs."
        )
