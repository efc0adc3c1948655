"""Settings of a calibration and of its validation."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from pisigma.files.errors import IdentificationError, MeasurementError, check_choice
from pisigma.files.setting import KEY, Option, split_names
from pisigma.measurement.camera.camera_files import CameraFiles

if TYPE_CHECKING:
    from pisigma.measurement.splits import SplitBy
    from pisigma.robot.robot_class import ClassName

_MAX_REPEATS = 1000

ModelKind = Literal["hybrid", "geometric"]


def parse_free_parameters(text: str) -> str | tuple[str, ...]:
    """Return the free parameters from "identifiable", "joint_offsets" or comma-separated names.

    Raises:
        IdentificationError: the text contains no name.
    """
    if not text.strip():
        raise IdentificationError(
            expected="identifiable, joint_offsets or names of parameters", value=text, option="free"
        )
    return text if text in ("identifiable", "joint_offsets") else split_names(text)


def parse_direction(text: str) -> tuple[float, ...]:
    """Return the direction of gravity from "X,Y,Z"."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) != 3:
        raise IdentificationError(
            expected="three numbers X,Y,Z, such as 0,0,-1", value=text, option="gravity"
        )
    return numbers


def parse_socket_distances(texts: Iterable[str]) -> dict[tuple[str, str], float]:
    """Return known distances between pairs of sockets [m] from "A,B,MM" [mm]."""
    distances: dict[tuple[str, str], float] = {}
    for one in texts:
        sockets, distance = _socket_distance(one)
        if sockets in distances:
            raise IdentificationError(
                f"expected one distance between the sockets {' and '.join(sockets)}, got a second one, '{one}'",
                value=one,
                option="socket_distance",
                remedy="remove one of them",
            )
        distances[sockets] = distance
    return distances


def _socket_distance(stated: str) -> tuple[tuple[str, str], float]:
    words = [word.strip() for word in stated.split(",")]
    try:
        distance = float(words[2])
    except (IndexError, ValueError):
        distance = 0.0
    if len(words) != 3 or not 0 < distance < float("inf"):
        raise IdentificationError(
            expected="A,B,MM with a distance > 0 mm, such as */0,*/1,50",
            value=stated,
            option="socket_distance",
        )
    return (words[0], words[1]), distance / 1e3


SocketDistances = Annotated[
    Mapping[tuple[str, str], float],
    Option(
        "--socket-distance",
        kind=list[str],
        read=parse_socket_distances,
        unit="mm",
        metavar="A,B,MM",
        help="Known distance between two sockets [mm], such as */0,*/1,50. An asterisk stands for the same text in "
        "both names, here for every placement.",
        is_key_only=True,
    ),
]


@dataclass(frozen=True)
class CalibrationSettings:
    """Settings of a calibration and of its validation.

    Attributes:
        model: kind of calibration: hybrid (geometry and, if the data support it, a joint correction) or geometric.
        folds: number of folds of the cross-validation (0: none). None: 5, or one per placement.
        hold_out: fraction of the rows to hold out once, instead of a cross-validation.
        split: how to split the rows: joints (at random), interleaved, time, space or placement. Rows with equal joint
            values always stay together.
        repeats: number of repeats of the cross-validation. None: 200 divided by the number of distinct joint
            configurations, but at least 1 and at most 10.
        jobs: number of processes that calibrate in parallel, for all rows and for each fold. Each uses one thread.
            None: one process with several threads.
        seed: random seed of the split and of the choice of training rows.
        train_rows: number of randomly chosen rows to calibrate with, also in each fold. None: all.
        free: parameters to identify: identifiable, joint_offsets, or names such as a_2,theta_3.
        prior_length: prior standard deviation of length errors [m] (0: no prior).
        prior_angle: prior standard deviation of angle errors [rad] (0: no prior).
        robot_class: expected size of the geometric errors: industrial, cobot, hobby (also for old and surgical arms)
            or servo (arms built from hobby servos). None: from the maker and the data.
        robust: down-weight outliers.
        features: features of the joint correction to try, such as gravity,lines,series. None: all that apply.
        gravity: direction of gravity in the robot's base frame, such as 0,0,-1. None: estimated from the data.
        new_frame_at: first line measured after the instrument was moved; the rows from there on are in a new frame.
        socket_distances: known distances [m] by the names of two sockets, such as {("*/0", "*/1"): 0.05}. An asterisk
            stands for the same text in both names, here for every placement.
        socket_sigma: standard deviation of the known distances between sockets [m]. All distances that one entry with
            an asterisk states have the same error, because the sockets are on the same plate.
        cameras: cameras and boards, for files of detected board corners.

    Raises:
        IdentificationError: the model is not a valid choice, does not use `gravity` or `features`, or only one of the
            two prior standard deviations is 0.
        MeasurementError: the split is not a valid choice, or settings of the validation exclude each other.
    """

    model: ModelKind = "hybrid"
    folds: Annotated[int | None, Option(min=0)] = None
    hold_out: Annotated[float | None, KEY] = None
    split: "SplitBy" = "joints"
    repeats: Annotated[int | None, Option(min=1, is_key_only=True)] = None
    jobs: int | None = None
    seed: Annotated[int, KEY] = 0
    train_rows: Annotated[int | None, KEY] = None
    free: Annotated[
        Literal["identifiable", "joint_offsets"] | tuple[str, ...],
        Option(kind=str, read=parse_free_parameters, is_key_only=True),
    ] = "identifiable"
    prior_length: Annotated[float, Option("--prior-mm", unit="mm", is_key_only=True)] = 1e-3
    prior_angle: Annotated[float, Option("--prior-mrad", unit="mrad", is_key_only=True)] = 1e-3
    robot_class: Annotated["ClassName | None", Option("--class", kind=str, is_key_only=True)] = None
    robust: Annotated[bool, KEY] = True
    features: Annotated[tuple[str, ...] | None, Option(kind=str, read=split_names, is_key_only=True)] = None
    gravity: Annotated[
        tuple[float, float, float] | None, Option(kind=str, read=parse_direction, is_key_only=True)
    ] = None
    new_frame_at: Annotated[tuple[int, ...], Option(metavar="LINE", is_key_only=True)] = ()
    socket_distances: SocketDistances = field(default_factory=dict)
    socket_sigma: Annotated[float, Option("--socket-sigma-mm", unit="mm", is_key_only=True)] = 1e-5
    cameras: CameraFiles | None = None

    def __post_init__(self) -> None:
        """Check choices and ranges, and that no settings exclude each other."""
        from pisigma.measurement.splits import SplitBy

        check_choice(IdentificationError, "model", self.model, get_args(ModelKind))
        check_choice(MeasurementError, "split", self.split, get_args(SplitBy))
        once = self.hold_out is not None or self.folds == 0
        if self.repeats is not None and self.repeats > 1 and once:
            raise MeasurementError(
                "only folds can be repeated",
                value=self.repeats,
                option="repeats",
                remedy="omit hold_out and folds=0",
            )
        if self.hold_out is not None and self.folds is not None:
            raise MeasurementError(
                f"{self.hold_out:g} cannot be combined with folds {self.folds}",
                value=self.hold_out,
                option="hold_out",
                remedy="omit one of them",
            )
        if not 0 <= self.seed < 2**63:
            raise MeasurementError(expected="an integer from 0 to 2^63 - 1", value=self.seed, option="seed")
        if (self.repeats or 0) > _MAX_REPEATS:
            raise MeasurementError(
                expected=f"at most {_MAX_REPEATS:,} repeats", value=self.repeats, option="repeats"
            )
        if self.jobs is not None and self.jobs < 1:
            raise MeasurementError(expected="an integer >= 1", value=self.jobs, option="jobs")
        for name in ("features", "gravity"):
            if (value := getattr(self, name)) is not None and self.model != "hybrid":
                raise IdentificationError(
                    f"a geometric calibration does not use this setting (got {value})",
                    value=value,
                    option=name,
                    remedy="omit it, or choose the model hybrid",
                )
        prior = (self.prior_length, self.prior_angle)
        if not all(map(math.isfinite, prior)) or min(prior) < 0 or (prior[0] == 0) != (prior[1] == 0):
            raise IdentificationError(
                "expected prior standard deviations > 0, or both 0 for no prior, got "
                f"{prior[0] * 1e3:g} mm and {prior[1] * 1e3:g} mrad",
                value=prior,
                option="prior_length and prior_angle",
            )

    def check_unused(self, reason: str) -> None:
        """Refuse settings that another kind of calibration does not use.

        Args:
            reason: what that calibration does instead, as a clause.

        Raises:
            IdentificationError: a setting other than `cameras`, `jobs` and `folds` of 0 is stated.
        """
        usual = CalibrationSettings(
            cameras=self.cameras, jobs=self.jobs, folds=0 if self.folds == 0 else None
        )
        stated = [name for name in self.__dataclass_fields__ if getattr(self, name) != getattr(usual, name)]
        if stated:
            raise IdentificationError(reason, option=", ".join(stated), remedy="omit it")


WITH_PRIOR = (
    "a calibration with a fleet prior always estimates all parameters of a hybrid, and chooses its folds"
)
"""Why a calibration with a prior uses few settings."""
