"""YAML file of frames and tools that a program names but does not define."""

from pathlib import Path

import torch
from jaxtyping import Float64
from pydantic import Field
from torch import Tensor

from pisigma.files.errors import OutputError
from pisigma.files.yaml_file import Section, read_yaml
from pisigma.robot.robot_file import FrameSection
from pisigma.robot.se3 import transform_from_xyz_zyx


class FrameFile(Section):
    """Frames relative to the origin of the robot description, and tools relative to its flange (the last row).

    The file uses the names of the program, such as `UFRAME 1`, `BASE_DATA[3]` or `wobj_table`; `tcp` is the tool of a
    URScript program that does not set one. `routines` are routines of other files that set neither frame nor tool;
    after a call of any other routine, poses are not changed until the program sets frame and tool again.
    """

    frames: dict[str, FrameSection] = Field(default_factory=dict)
    tools: dict[str, FrameSection] = Field(default_factory=dict)
    routines: tuple[str, ...] = ()

    @staticmethod
    def read(path: Path | None) -> "FrameFile":
        """Read the file of frames and tools; None stands for an empty file.

        Raises:
            OutputError: the file is not a valid frame file (YAML); the message states file, line and key.
        """
        return FrameFile() if path is None else read_yaml(path, FrameFile, OutputError)

    def frame(self, name: str) -> Float64[Tensor, "4 4"] | str:
        """Return a frame by name, or the reason why it is unknown."""
        return _lookup(self.frames, name, "frame")

    def sets_no_frame(self, routine: str) -> bool:
        """Return whether a routine in another file is stated to set neither frame nor tool."""
        return routine.upper() in map(str.upper, self.routines)

    def tool(self, name: str) -> Float64[Tensor, "4 4"] | str:
        """Return a tool by name, or the reason why it is unknown."""
        return _lookup(self.tools, name, "tool")


def _lookup(sections: dict[str, FrameSection], name: str, kind: str) -> Float64[Tensor, "4 4"] | str:
    section = next((value for key, value in sections.items() if key.upper() == name.upper()), None)
    if section is None:
        return f"the {kind} '{name}' is not stated; state it in --frames"
    return transform_from_xyz_zyx(torch.from_numpy(section.to_si()))
