"""The languages of controllers: which file, which names, and what cannot be written in them."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pisigma.errors import OutputError
from pisigma.export.programs.fanuc_ls import COUPLING, WORLD, fanuc_ls
from pisigma.export.programs.krl import krl
from pisigma.export.programs.rapid import rapid
from pisigma.export.programs.targets import Targets
from pisigma.export.programs.urscript import OWN_LENGTHS, urscript
from pisigma.robot.description import Robot

CONFIGURATION = re.compile(r"[NF] ([LR] )?[UD] [TB], -?\d, -?\d, -?\d")


@dataclass(frozen=True)
class Language:
    """One language.

    Attributes:
        name: of the language.
        longest: characters that a program's name may have.
        reserved: words of the language that may be no name, in capitals.
        write: makes the text of targets, name of the program, whether Cartesian.
        keeps_branch: whether Cartesian targets may lie on several branches.
        capitals: whether names are written in capitals.
    """

    name: str
    longest: int
    reserved: frozenset[str]
    write: Callable[[Targets, str, bool], str]
    keeps_branch: bool = False
    capitals: bool = False

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


def _words(text: str) -> frozenset[str]:
    return frozenset(text.upper().split())


_FILES_OF_SYSTEMS = _words("con prn aux nul") | {f"{p}{i}" for p in ("COM", "LPT") for i in range(1, 10)}

LANGUAGES = {
    ".script": Language(
        "URScript",
        64,
        _words(
            "and break continue def elif else end enum false for global halt if local not or pass return run sec "
            "struct then thread true while xor movej get_inverse_kin pose_trans set_tcp p speed acceleration frame"
        ),
        urscript,
        keeps_branch=True,
    ),
    ".src": Language(
        "KRL",
        24,
        _words(
            "and anin anout b_and b_exor b_not b_or bool brake bas case ccomp channel char circ circ_rel confirm "
            "const continue ct_i decl def default defdat deffct digin do else end enddat endfct endfor endif "
            "endloop endspline endswitch endwhile enum exit exor ext extfct false for frame global goto halt if "
            "import int interrupt is lin lin_rel loop maximum minimum not or pos e6pos axis e6axis priority ptp "
            "ptp_rel public pulse real repeat resume return sec signal slin spl spline spo sptp step struc "
            "switch then to trigger true until wait when while speed i"
        )
        | _FILES_OF_SYSTEMS,
        krl,
    ),
    ".mod": Language(
        "RAPID",
        27,  # of 32, with _tool behind it
        _words(
            "alias and backward bool case connect const default div do else elseif endfor endfunc endif endmodule "
            "endproc endrecord endtest endtrap endwhile error exit false for from func goto if inout local mod "
            "module nostepin not noview num or pers proc raise readonly record retry return step string "
            "sysmodule task test then to trap true trynext undo user var viewonly while with xor slow fine tool0 "
            "wobj0 movej moveabsj confj base"
        ),
        rapid,
    ),
    ".ls": Language("FANUC", 36, _FILES_OF_SYSTEMS, fanuc_ls, capitals=True),
}
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
    if config is not None and (path.suffix.lower() != ".ls" or not cartesian):
        raise OutputError("--config goes with a .ls file and --targets cartesian; leave it out.")
    if cartesian and path.suffix.lower() == ".ls":
        if config is None:
            raise OutputError(
                f"{path}: FANUC's Cartesian targets need the arm's configuration, which pisigma does not know; "
                "give it as the pendant shows it, such as --config 'N U T, 0, 0, 0', or take --targets joints."
            )
        if not CONFIGURATION.fullmatch(config):
            raise OutputError(f"--config '{config}': one such as 'N U T, 0, 0, 0' was wanted.")


def warnings(path: Path, cartesian: bool) -> tuple[str, ...]:
    """What has to be known before a program is used, besides what is true of all of them."""
    suffix = path.suffix.lower()
    if suffix == ".ls":
        return (COUPLING, WORLD) if cartesian else (COUPLING,)
    return (OWN_LENGTHS,) if suffix == ".script" and cartesian else ()


def program_text(targets: Targets, path: Path, cartesian: bool, config: str | None = None) -> str:
    """The program for a file.

    Args:
        targets: the targets.
        path: the file; its suffix is one of `LANGUAGES`, its name is the program's.
        cartesian: write poses instead of joint values.
        config: with .ls and `cartesian` the configuration of all poses.

    Raises:
        OutputError: the program cannot be written so.
        UnreachablePoseError: a pose has no target; the message names line and status.
    """
    check_program(path, targets.robot, cartesian, config)
    targets.check_all_given()
    language = LANGUAGES[path.suffix.lower()]
    if cartesian and not language.keeps_branch and len(set(targets.branch)) > 1:
        other = next(row for row, name in enumerate(targets.branch) if name != targets.branch[0])
        raise OutputError(
            f"{targets.source}, line {targets.line[other]}: the target lies on branch {targets.branch[other]}, "
            f"that of line {targets.line[0]} on branch {targets.branch[0]}, which a {language.name} program of "
            "poses cannot tell apart; take --targets joints or one --branch."
        )
    name = language.program_name(path)
    if config is not None:
        return fanuc_ls(targets, name, cartesian, config)
    return language.write(targets, name, cartesian)
