"""Settings for detecting boards in images, and for calibrating a camera."""

from dataclasses import dataclass
from typing import Annotated

from pisigma.files.setting import KEY, Option

MaxBlur = Annotated[float, Option("--max-blur-px", min=0.0, is_key_only=True)]


@dataclass(frozen=True)
class DetectionSettings:
    """Settings for detecting boards in images.

    Attributes:
        max_blur: maximum blur of the edges in an image, as a standard deviation [px].
        within: maximum difference between the time stamps of an image and of its joint values [s].
        video_start: time at which a video starts, by the clock of the joint values [s]; required if
            these have a column `time`.
    """

    max_blur: MaxBlur = 3.0
    within: Annotated[float, KEY] = 0.2
    video_start: Annotated[float | None, KEY] = None


@dataclass(frozen=True)
class IntrinsicsSettings:
    """Settings for calibrating a camera.

    Attributes:
        name: name of the camera.
        free_k3: also estimate k3 (default: 0).
        max_blur: maximum blur of the edges in an image, as a standard deviation [px].
    """

    name: str = "camera"
    free_k3: Annotated[bool, Option("--k3", is_key_only=True)] = False
    max_blur: MaxBlur = 3.0
