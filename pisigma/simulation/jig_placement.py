"""Where a jig stands."""

import os
from collections.abc import Sequence

import torch
from jaxtyping import Float64
from pydantic import Field
from torch import Tensor

from pisigma.errors import RecipeError
from pisigma.measurement.jig import Jig
from pisigma.robot.robot_file import FrameSection
from pisigma.se3 import transform_from_xyzrpy
from pisigma.yaml_file import Section


class JigPlacement(Section):
    """A jig that stands somewhere, as the operator believes and as it really does.

    `T_jig_base = Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)` says where the robot's base is, seen
    from the jig (Lim et al., eq. 1). A jig on the floor that is turned about the vertical has a roll.

    Attributes:
        name: of the placement, and of the frame of its touches.
        jig: name of a jig that comes with pisigma, or its YAML file.
        base: T_jig_base as the operator believes.
        true_base: T_jig_base as it really is; left out, as the operator believes.
    """

    name: str = Field(min_length=1)
    jig: str = "stepped"
    base: FrameSection
    true_base: FrameSection | None = None

    def load_jig(self) -> Jig:
        """The jig.

        Raises:
            MeasurementError: there is no such jig.
        """
        return Jig.load(os.fspath(self.jig))

    @property
    def T_jig_base(self) -> Float64[Tensor, "4 4"]:
        """Where the operator believes that it stands [m]."""
        return transform_from_xyzrpy(torch.from_numpy(self.base.to_si()))

    @property
    def true_T_jig_base(self) -> Float64[Tensor, "4 4"]:
        """Where it really stands [m]."""
        return transform_from_xyzrpy(torch.from_numpy((self.true_base or self.base).to_si()))


def check_names(placements: Sequence[JigPlacement]) -> None:
    """Refuse two placements of one name.

    Raises:
        RecipeError: a name stands twice, or there is no placement.
    """
    names = [placement.name for placement in placements]
    if not names:
        raise RecipeError("touches: no jig is placed; state at least one placement.")
    for name in names:
        if names.count(name) > 1:
            raise RecipeError(
                f"touches: the placement '{name}' stands twice; a jig that was moved has a new "
                "frame, so name it anew."
            )
