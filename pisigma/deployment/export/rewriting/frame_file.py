"""Frames and tools that a program names without stating them, as a YAML file."""

from pathlib import Path

import torch
from jaxtyping import Float64
from pydantic import Field
from torch import Tensor

from pisigma.files.errors import OutputError
from pisigma.files.yaml_file import Section, read_yaml
from pisigma.robot.robot_file import FrameSection
from pisigma.robot.se3 import transform_from_xyzrpy


class FrameFile(Section):
    """What a program names: frames in the origin of the robot description, tools in its flange (the last row).

    Names are the program's, such as `UFRAME 1`, `BASE_DATA[3]` or `wobj_table`; `tcp` is the tool that a URScript
    program does not set. `routines` are those of other files that set neither frame nor tool: a program that calls any
    other one leaves its poses until it sets them again.
    """

    frames: dict[str, FrameSection] = Field(default_factory=dict)
    tools: dict[str, FrameSection] = Field(default_factory=dict)
    routines: tuple[str, ...] = ()

    @staticmethod
    def read(path: Path | None) -> "FrameFile":
        """Read a file; None is an empty one.

        Raises:
            OutputError: the file is no such YAML; the message names file, line and key.
        """
        return FrameFile() if path is None else read_yaml(path, FrameFile, OutputError)

    def frame(self, name: str) -> Float64[Tensor, "4 4"] | str:
        """The frame of a name, or why it is not known."""
        return _lookup(self.frames, name, "frame")

    def sets_neither(self, routine: str) -> bool:
        """Say whether a routine of another file is stated to set neither frame nor tool."""
        return routine.upper() in map(str.upper, self.routines)

    def tool(self, name: str) -> Float64[Tensor, "4 4"] | str:
        """The tool of a name, or why it is not known."""
        return _lookup(self.tools, name, "tool")


def _lookup(sections: dict[str, FrameSection], name: str, kind: str) -> Float64[Tensor, "4 4"] | str:
    section = next((value for key, value in sections.items() if key.upper() == name.upper()), None)
    if section is None:
        return f"the {kind} '{name}' is not stated; state it in --frames"
    return transform_from_xyzrpy(torch.from_numpy(section.to_si()))
