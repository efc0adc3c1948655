"""What a controller's language is: how its programs are named and written, and what they cannot hold."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pisigma.errors import OutputError
from pisigma.export.programs.targets import Targets


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


@dataclass(frozen=True)
class Language:
    """One language.

    Attributes:
        name: of the language.
        longest: characters that a program's name may have.
        reserved: words of the language that may be no name, in capitals.
        write: makes the text of a program.
        keeps_branch: whether Cartesian targets may lie on several branches.
        capitals: whether names are written in capitals.
        configuration: what the arm's configuration looks like, where Cartesian targets need one.
        cautions: what has to be known before a program is used, besides what is true of all languages.
        cartesian_cautions: the same of Cartesian targets.
    """

    name: str
    longest: int
    reserved: frozenset[str]
    write: Callable[[Program], str]
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


def words(text: str) -> frozenset[str]:
    """Words of a language in capitals, for `Language.reserved`."""
    return frozenset(text.upper().split())


FILES_OF_SYSTEMS = words("con prn aux nul") | {f"{p}{i}" for p in ("COM", "LPT") for i in range(1, 10)}
"""Names that some controllers' file systems keep for devices."""
