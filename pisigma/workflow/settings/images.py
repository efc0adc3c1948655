"""How boards are found in images, and a camera is calibrated by them."""

from dataclasses import dataclass
from typing import Annotated

from pisigma.files.setting import Option

MostBlur = Annotated[float, Option("--most-blur-px", least=0.0)]


@dataclass(frozen=True)
class DetectionSettings:
    """How corners are detected.

    Attributes:
        most_blur: images whose edges are blurred more (standard deviation) are left out [px].
        within: largest difference of time stamps of images and joint values that are joined [s].
    """

    most_blur: MostBlur = 3.0
    within: float = 0.2


@dataclass(frozen=True)
class IntrinsicsSettings:
    """How a camera is calibrated.

    Attributes:
        name: name of the camera.
        free_k3: identify k3, too, which is 0 else.
        most_blur: images whose edges are blurred more (standard deviation) are left out [px].
    """

    name: str = "camera"
    free_k3: Annotated[bool, Option("--k3")] = False
    most_blur: MostBlur = 3.0
