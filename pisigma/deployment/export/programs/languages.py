"""Languages of controllers: names and limits of programs, and writing of programs."""

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
    format_labelled,
    format_numbers,
    metres_and_rotation_vector,
    millimetres_and_euler,
    position_in_mm,
    quaternion,
)
from pisigma.files.errors import OutputError, Place
from pisigma.files.templates import template_environment
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.status import Status

TEST = "TEST IT AT LOW SPEED FIRST: neither the targets nor the motions between them were checked for collisions."
COUNTING = (
    "Joint values have the zeros and directions of the robot description '{robot}'; the controller has to use the "
    "same."
)
_CARTESIAN = (
    "Poses are those of the nominal robot at the corrected joint values: the controller has to compute with the "
    "nominal robot, and its accuracy options have to be off.",
    "The frame of the model is relative to the origin of the robot description, which has to be that of the "
    "controller; its tool is relative to the last row, which has to be the controller's flange.",
)


@dataclass(frozen=True, eq=False)
class Program:
    """Content of a program: stops of a robot with six revolute joints.

    Attributes:
        name: name of the program.
        robot: nominal robot.
        heading: sentences on the purpose and the requirements of the program.
        q: joint values of every stop [rad].
        labels: comment that precedes the move to every stop.
        waits: waiting time at every stop [s]; 0 for none.
        cartesian_targets: targets, if the program has poses instead of joint values; otherwise None.
        config: configuration of the arm in all poses, if the language requires a configuration; otherwise "".
    """

    name: str
    robot: Robot
    heading: list[str]
    q: Float64[Tensor, "stops 6"]
    labels: tuple[str, ...]
    waits: tuple[float, ...]
    cartesian_targets: Targets | None = None
    config: str = ""

    @staticmethod
    def from_targets(targets: Targets, name: str, cartesian: bool, config: str = "") -> "Program":
        """Return the program that moves to the targets, none of which may be missing."""
        sentences = [targets.title, TEST, COUNTING.format(robot=targets.robot.name)]
        sentences += [*(_CARTESIAN if cartesian else ()), *targets.remarks]
        sentences += [targets.domain_warning] if targets.domain_warning else []
        labels = [
            f"line {line}{' OUTSIDE DOMAIN' if status == Status.OUTSIDE_DOMAIN else ''}"
            for line, status in zip(targets.line, targets.status, strict=True)
        ]
        waits = (0.0,) * len(labels)
        shown = targets if cartesian else None
        return Program(name, targets.robot, sentences, targets.q, tuple(labels), waits, shown, config)

    @property
    def degrees(self) -> list[list[float]]:
        """Joint values of every stop [deg]."""
        degrees: list[list[float]] = torch.rad2deg(self.q).tolist()
        return degrees


@dataclass(frozen=True)
class Language:
    """A language.

    Attributes:
        name: name of the language.
        template: template of its programs in the folder `templates`.
        max_name_length: largest number of characters of a program's name.
        reserved: words of the language that cannot be names, in capitals.
        line_end: line ending.
        max_lines: largest number of numbered lines of a program; None for any number.
        allows_several_branches: whether Cartesian targets may be on several branches.
        uses_capitals: whether names are written in capitals.
        configuration: pattern of configurations of the arm, if Cartesian targets require a configuration.
        cautions: notes for the user of a program, in addition to those for all languages.
        cartesian_cautions: additional notes for Cartesian targets.
    """

    name: str
    template: str
    max_name_length: int
    reserved: frozenset[str]
    line_end: str = "\r\n"
    max_lines: int | None = None
    allows_several_branches: bool = False
    uses_capitals: bool = False
    configuration: re.Pattern[str] | None = None
    cautions: tuple[str, ...] = ()
    cartesian_cautions: tuple[str, ...] = ()

    def program_name(self, path: Path) -> str:
        """Return the name of a program, which is that of its file.

        Raises:
            OutputError: the name is not valid in the language; the message proposes a valid name.
        """
        stem = path.stem.upper() if self.uses_capitals else path.stem
        fits = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", stem, re.ASCII) and len(stem) <= self.max_name_length
        if fits and stem.upper() not in self.reserved:
            return stem
        other = re.sub(r"[^A-Za-z0-9]+", "_", stem).strip("_")
        other = other if other[:1].isalpha() else f"P{'_' if other else ''}{other}"
        other = f"P_{other}" if other.upper() in self.reserved else other
        raise OutputError(
            f"expected a file name that is a valid {self.name} program name: at most {self.max_name_length} letters, "
            "digits and _, starting with a letter, and not a reserved word",
            expected=f"a {self.name} program name of at most {self.max_name_length} characters",
            value=path.stem,
            option="--out",
            at=Place(path),
            remedy=f"choose another name, such as {other[: self.max_name_length].rstrip('_')}{path.suffix}",
        )

    def write(self, program: Program) -> str:
        """Return the text of a program.

        Raises:
            OutputError: the program has more lines than the language allows.
        """
        sentences = [*self.cautions, *(self.cartesian_cautions if program.cartesian_targets else ())]
        content = {"program": program, "targets": program.cartesian_targets, "cautions": sentences}
        text = _templates().get_template(self.template).render(content) + "\n"
        lines = len(_NUMBERED_LINE.findall(text))
        if self.max_lines is not None and lines > self.max_lines:
            raise OutputError(
                f"expected at most {self.max_lines} lines for a {self.name} controller, got {lines} in the program "
                f"{program.name}",
                expected=f"at most {self.max_lines} lines",
                value=lines,
                remedy="split the file of poses",
            )
        return text.replace("\n", self.line_end)


_NUMBERED_LINE = re.compile(r"(?m)^ *\d+:")


@functools.cache
def _templates() -> jinja2.Environment:
    filters = (
        format_numbers,
        format_labelled,
        comments,
        position_in_mm,
        millimetres_and_euler,
        metres_and_rotation_vector,
        quaternion,
    )
    return template_environment(
        "pisigma.deployment.export.programs", {filter.__name__: filter for filter in filters}
    )


def reserved_words(text: str) -> frozenset[str]:
    """Split words of a language, in capitals, for `Language.reserved`."""
    return frozenset(text.upper().split())


_FILES_OF_SYSTEMS = reserved_words("con prn aux nul") | {
    f"{p}{i}" for p in ("COM", "LPT") for i in range(1, 10)
}
"""Names that some controllers' file systems reserve for devices."""

URSCRIPT = Language(
    name="URScript",
    template="urscript.j2",
    max_name_length=64,
    reserved=reserved_words(
        "and break continue def elif else end enum false for global halt if local not or pass return run sec "
        "struct then thread true while xor movej get_inverse_kin pose_trans set_tcp p speed acceleration frame"
    ),
    line_end="\n",
    allows_several_branches=True,
    cartesian_cautions=(
        "The controller computes poses with its factory calibration if it has one, not with the nominal robot; joint "
        "targets do not depend on that.",
    ),
)
KRL = Language(
    name="KRL",
    template="krl.j2",
    max_name_length=24,
    reserved=_FILES_OF_SYSTEMS
    | reserved_words(
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
    max_name_length=27,  # names have at most 32 characters, and _tool is appended
    reserved=reserved_words(
        "alias and backward bool case connect const default div do else elseif endfor endfunc endif endmodule endproc "
        "endrecord endtest endtrap endwhile error exit false for from func goto if inout local mod module nostepin not "
        "noview num or pers proc raise readonly record retry return step string sysmodule task test then to trap true "
        "trynext undo user var viewonly while with xor slow fine tool0 wobj0 movej moveabsj confj base"
    ),
)
FANUC = Language(
    name="FANUC",
    template="fanuc.j2",
    max_name_length=36,
    reserved=_FILES_OF_SYSTEMS,
    max_lines=9999,
    uses_capitals=True,
    configuration=re.compile(r"[NF] ([LR] )?[UD] [TB], -?\d, -?\d, -?\d"),
    cautions=(
        "On FANUC pendants J3 is measured from the horizontal, so it changes with J2. The values here are defined like "
        "the joint values of the model's measurements; if those were angles between links, J3 has to be converted.",
    ),
    cartesian_cautions=(
        "UFRAME is relative to the world frame, which on FANUC robots is at the height of J2.",
    ),
)

LANGUAGES = {".script": URSCRIPT, ".src": KRL, ".mod": RAPID, ".ls": FANUC}
"""Languages by the suffix of the file."""


def check_program(path: Path, robot: Robot, cartesian: bool, config: str | None) -> None:
    """Check that a program can be written before the targets are computed.

    Raises:
        OutputError: the name of the file, the robot or the options are invalid.
    """
    language = LANGUAGES[path.suffix.lower()]
    language.program_name(path)
    turning = sum(axis.type == "revolute" for axis in robot.axes)
    if len(robot.axes) != 6 or turning != 6:
        raise OutputError(
            f"{language.name} programs require a robot with six revolute joints; robot '{robot.name}' has {turning} "
            f"revolute and {len(robot.axes) - turning} prismatic joints",
            expected="six revolute joints",
            value=robot.name,
            at=Place(path),
            remedy="choose a .csv file",
        )
    needed = language.configuration if cartesian else None
    if needed is None:
        if config is not None:
            endings = " or ".join(suffix for suffix, other in LANGUAGES.items() if other.configuration)
            raise OutputError(
                f"the option applies only to {endings} files with --targets cartesian",
                option="--config",
                value=config,
                remedy="omit it",
            )
    elif config is None:
        raise OutputError(
            f"Cartesian targets of {language.name} require the arm's configuration, which pisigma does not know",
            option="--config",
            at=Place(path),
            remedy="give it as displayed by the pendant, such as --config 'N U T, 0, 0, 0', or choose --targets joints",
        )
    elif not needed.fullmatch(config):
        raise OutputError(
            expected="a configuration such as 'N U T, 0, 0, 0'", value=config, option="--config"
        )


def cautions(path: Path, cartesian: bool) -> tuple[str, ...]:
    """Return notes for the user of a program, in addition to those for all programs."""
    language = LANGUAGES[path.suffix.lower()]
    return (*language.cautions, *(language.cartesian_cautions if cartesian else ()))


def program_text(targets: Targets, path: Path, cartesian: bool, config: str | None = None) -> str:
    """Return the text of a program for a file.

    Args:
        targets: targets of the program.
        path: file to write; its suffix is one of `LANGUAGES`, its stem is the name of the program.
        cartesian: whether to write poses instead of joint values.
        config: configuration of all poses, if the language requires a configuration.

    Raises:
        OutputError: the program cannot be written to this file.
        UnreachablePoseError: a pose has no target; the message states line and status.
    """
    check_program(path, targets.robot, cartesian, config)
    targets.check_complete()
    language = LANGUAGES[path.suffix.lower()]
    if cartesian and not language.allows_several_branches and len(set(targets.branch)) > 1:
        other = next(row for row, name in enumerate(targets.branch) if name != targets.branch[0])
        raise OutputError(
            f"the target is on branch {targets.branch[other]} and that of line {targets.line[0]} on branch "
            f"{targets.branch[0]}, but poses of a {language.name} program cannot distinguish them",
            expected=f"a target on branch {targets.branch[0]}",
            value=targets.branch[other],
            at=Place(targets.source, targets.line[other]),
            remedy="choose --targets joints or one --branch",
        )
    if cartesian and language.configuration:
        _check_turns(targets)
    return language.write(Program.from_targets(targets, language.program_name(path), cartesian, config or ""))


def _check_turns(targets: Targets) -> None:
    """Check that all joint values have the same number of turns, because one configuration states it for all."""
    turns = torch.floor(targets.q / (2 * torch.pi) + 0.5)
    if len(turns) and bool((turns != turns[0]).any()):
        row = int((turns != turns[0]).any(-1).nonzero()[0, 0])
        raise OutputError(
            f"the number of turns of a joint differs from line {targets.line[0]}, so one --config cannot describe both",
            option="--config",
            at=Place(targets.source, targets.line[row]),
            remedy="choose --targets joints or write two programs",
        )
