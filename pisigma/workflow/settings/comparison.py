"""Settings for comparing two models."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, get_args

from pisigma.files.errors import IdentificationError, check_choice
from pisigma.files.setting import HIDDEN, KEY, Option
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.validation.resampling import Bootstrap

if TYPE_CHECKING:
    from pisigma.lifetime.comparison.model_pair import FrameChoice

_FRAMES = {True: "fixed", False: "fitted"}


@dataclass(frozen=True)
class ComparisonSettings:
    """Settings for comparing two models.

    Attributes:
        frames: "fixed" compares base and tool unchanged, for models measured in the same frame with the same tool;
            "fitted" first fits base and tool of the second model so that the arms agree best, and compares them
            separately.
        level: probability of reporting a difference in any parameter by chance.
        bootstrap: how confidence intervals of errors on rows are computed.
        cameras: cameras and boards, for files of detected board corners.

    Raises:
        IdentificationError: the level is not a probability, or `frames` is not a valid choice.
    """

    frames: Annotated[
        "FrameChoice",
        Option(
            "--fixed-frames",
            kind=bool,
            read=_FRAMES.get,
            help="Compare base and tool unchanged, for models measured in the same frame with the same tool. "
            "Otherwise, base and tool of the second model are first fitted so that the arms agree best, and are "
            "compared separately.",
        ),
    ] = "fitted"
    level: Annotated[float, KEY] = 0.01
    bootstrap: Annotated[Bootstrap, HIDDEN] = field(default_factory=Bootstrap)
    cameras: CameraFiles | None = None

    def __post_init__(self) -> None:
        """Check `frames` and the level."""
        from pisigma.lifetime.comparison.model_pair import FrameChoice

        check_choice(IdentificationError, "frames", self.frames, get_args(FrameChoice))
        if not 0.0 < self.level < 1.0:
            raise IdentificationError(
                expected="a probability between 0 and 1, such as 0.01", value=self.level, option="level"
            )
