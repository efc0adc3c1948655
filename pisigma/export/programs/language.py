"""What a controller's language is: how its programs are named and written, and what they cannot hold."""

import functools
import re
from dataclasses import dataclass
from pathlib import Path

import jinja2
import torch

from pisigma.errors import OutputError
from pisigma.export.programs.targets import Targets
from pisigma.export.programs.text import (
    comments,
    labelled,
    metres_and_rotation_vector,
    millimetres,
    millimetres_and_euler,
    numbers,
    quaternion,
)
from pisigma.kinematics.status import Status
from pisigma.templates import template_environment

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
    """What a program is to hold.

    Attributes:
        targets: of a robot with six joints that turn, none missing.
        name: of the program.
        cartesian: whether it holds poses instead of joint values.
        config: configuration of the arm in all poses, where the language wants one; else "".
    """

    targets: Targets
    name: str
    cartesian: bool
    config: str = ""

    @property
    def heading(self) -> list[str]:
        """Sentences on what the program does and on what it relies."""
        targets = self.targets
        said = [targets.title, TEST, COUNTING.format(robot=targets.robot.name)]
        if self.cartesian:
            said += [*CARTESIAN, *targets.remarks]
        return [*said, targets.doubt] if targets.doubt else said

    @property
    def degrees(self) -> list[list[float]]:
        """Joint values of every target [deg]."""
        degrees: list[list[float]] = torch.rad2deg(self.targets.q).tolist()
        return degrees

    def place(self, row: int) -> str:
        """What is said before a move: where its pose stands, and whether its correction is a guess."""
        guess = " OUTSIDE DOMAIN" if self.targets.status[row] == Status.OUTSIDE_DOMAIN else ""
        return f"line {self.targets.line[row]}{guess}"


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
        content = {"program": program, "targets": program.targets, "cautions": said}
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
    return template_environment("pisigma.export.programs", {filter.__name__: filter for filter in filters})
