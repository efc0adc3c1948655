"""Warnings of a calibration about its measurements."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class CalibrationWarning:
    """Something that the measurements do not determine, or that does not fit, and what to do about it.

    Attributes:
        kind: kind of the warning.
        subject: name of the joint, target or frame concerned; empty if it concerns all measurements.
        sentence: the warning as a sentence.
    """

    kind: Literal[
        "few_values",
        "still_joint",
        "target_on_axis",
        "scale_of_boards",
        "scale_of_touches",
        "scale_of_sockets",
        "touched_frame",
        "floating_frame",
        "frame_misfit",
        "angle_disagreement",
    ]
    subject: str
    sentence: str
