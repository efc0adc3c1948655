"""Schema of `model.yaml`, and its checksum, which reveals truncated or edited files."""

import hashlib
import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, FiniteFloat, PlainValidator

from pisigma.files.errors import ModelError, Place
from pisigma.files.model_files import DESCRIPTION, read_model_file
from pisigma.files.yaml_file import Section, StoredFigures, parse_yaml
from pisigma.files.yaml_writing import yaml_text
from pisigma.joint_correction.feature import FeatureSection
from pisigma.joint_correction.registry import feature_section
from pisigma.measurement.sensors.sensor import OtherUnit
from pisigma.robot.robot_file import RobotDocument

FORMAT = 5
"""Format number that this version writes; `pisigma.model.folder.upgrade` converts folders of earlier formats."""
_MAX_FACTORS, _MAX_UNITS = 100, 1000
"""Largest number of factors of a product unit, and of product units of a network."""
_CHECKSUM = re.compile(r"(.*^)sha256: ([0-9a-f]{64})\n", re.DOTALL | re.MULTILINE)

_Vector = tuple[float, float, float]
_Frame = tuple[float, float, float, float, float, float]
"""A frame as x, y, z [m], roll, pitch, yaw [rad]."""
_Feature = Annotated[FeatureSection, PlainValidator(feature_section)]


class InconsistentFolderError(ValueError):
    """Error for parts of a model folder that do not fit together; `load_model` raises a `ModelError` with its fields.

    Attributes:
        file: name of the faulty file.
        column: faulty key of `model.yaml`, or None.
        value: the faulty value, or the name of a tensor.
    """

    def __init__(
        self, problem: str, *, file: str = DESCRIPTION, column: str | None = None, value: Any = None
    ) -> None:
        super().__init__(problem)
        self.file, self.column, self.value = file, column, value


class GroupSection(Section):
    """Section of a joint group of the network, see `pisigma.network.correction_network.JointGroup`."""

    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    inputs: Annotated[tuple[str, ...], Field(min_length=1)]
    orders: Annotated[
        tuple[Annotated[int, Field(ge=1, le=_MAX_FACTORS)], ...], Field(min_length=1, max_length=_MAX_UNITS)
    ]
    reference: tuple[_Vector, _Vector, _Vector]


class LearnedSection(Section):
    """Section of the joint correction of a hybrid calibration, and of the geometry that belongs to it.

    Attributes:
        features: features of the unit of order 1.
        orders: number of factors of every product unit.
        bases: bases of the hybrid's geometry, by frame.
        tools: tools of the hybrid's geometry, by target.
    """

    features: Annotated[tuple[_Feature, ...], Field(max_length=_MAX_UNITS)]
    orders: Annotated[tuple[Annotated[int, Field(ge=2, le=_MAX_FACTORS)], ...], Field(max_length=_MAX_UNITS)]
    bases: dict[str, _Frame]
    tools: dict[str, _Frame]


class UnknownsSection(Section):
    """Section of the unknown parameters of one kind of sensor; see `measurement.sensors.sensor.UnknownGroup`."""

    name: str
    columns: tuple[str, ...] = Field(min_length=1)
    owners: tuple[str, ...] = Field(min_length=1)
    frames: tuple[str, ...] = ()
    angles: tuple[str, ...] = ()
    units: dict[str, OtherUnit] = Field(default_factory=dict)


class UncertaintySection(StoredFigures):
    """Section of the unknowns to which the rows of the covariance root in the weights file belong, in order.

    Attributes:
        unknowns: unknown sensor parameters, group by group.
        values: values of the unknown sensor parameters by group and owner, in the owner's frame [m or rad]; empty in
            folders that were upgraded from a format without them.
        free: indices of the parameters that have a row in the root, before the rows of all weights; the rows of other
            parameters are 0.
        rounded: whether the root is stored in whole numbers, see `pisigma.estimation.rounded_root.RoundedRoot`.
        features: names of the features whose weights follow: the features of the learned part, and `products` for
            the products of inputs in its product units.
        variance_factor: see `pisigma.calibration.hybrid.uncertainty.PositionUncertainty`.
        noise: see `pisigma.calibration.hybrid.noise.CalibrationNoise`.
        stated_noise: see `pisigma.calibration.hybrid.noise.CalibrationNoise.median_stated_sigma`.
    """

    unknowns: tuple[UnknownsSection, ...] = ()
    values: dict[str, dict[str, tuple[FiniteFloat, ...]]] = Field(default_factory=dict)
    free: tuple[Annotated[int, Field(ge=0)], ...]
    rounded: bool = False
    features: Annotated[tuple[str, ...], Field(max_length=_MAX_UNITS)]
    variance_factor: Annotated[float, Field(gt=0, alias="prior_scale")]
    noise: dict[str, Annotated[FiniteFloat, Field(gt=0)]] = Field(default_factory=dict)
    stated_noise: dict[str, Annotated[FiniteFloat, Field(gt=0)]] | None = None


class ProvenanceSection(Section):
    """Section of the provenance, see `pisigma.model.calibrated_model.Provenance`."""

    recipe: str
    recipe_sha256: str
    data_source: str
    data_sha256: str
    rows: int
    rows_left_out: int
    rule: str
    seed: int
    versions: dict[str, str]


class ModelDocument(Section):
    """Contents of `model.yaml` except for the checksum in its last line."""

    model_config = ConfigDict(protected_namespaces=())

    format: Literal[5]
    name: str
    kind: str
    branches: tuple[str, ...]
    weights_sha256: str
    compiled_sha256: str | None = None
    drawing_sha256: str | None = None
    robot: RobotDocument
    calibrated: RobotDocument | None
    bases: dict[str, _Frame]
    tools: dict[str, _Frame]
    network: tuple[GroupSection, ...]
    learned: LearnedSection | None = None
    uncertainty: UncertaintySection | None = None
    provenance: ProvenanceSection
    metrics: dict[str, Any]


def document_text(document: dict[str, Any]) -> str:
    """Return the text of a document without its last two lines, see `write_document`."""
    return yaml_text({"format": FORMAT, **document})


def write_document(text: str, compiled_sha256: str | None, path: Path) -> None:
    """Write a document, followed by the hash of `compiled.npz` and the checksum of all preceding lines.

    Args:
        text: text from `document_text`.
        compiled_sha256: hash of `compiled.npz`; None if there is no such file.
        path: file to write.
    """
    text = f"{text}compiled_sha256: {compiled_sha256 or 'null'}\n"
    path.write_text(f"{text}sha256: {_digest(text)}\n", encoding="utf-8", newline="\n")


def read_document(path: Path) -> ModelDocument:
    """Read and check the document.

    Raises:
        ModelError: the file cannot be read, has another format, was truncated or edited, or does not describe a model.
    """
    text = read_signed_text(path)
    stated = stated_format(text)
    if stated is not None and 1 <= stated < FORMAT:
        raise ModelError(
            f"format {stated} was written by an earlier version",
            value=stated,
            at=Place(path, column="format"),
            remedy=f"run `pisigma upgrade {path.parent}` once to convert the folder",
        )
    return parse_yaml(text, ModelDocument, ModelError, source=str(path))


def read_signed_text(path: Path) -> str:
    """Return the lines before the checksum, in this format or an earlier one.

    Raises:
        ModelError: the file cannot be read, has a newer format, was truncated or edited, or does not describe a model.
    """
    try:
        text = read_model_file(path.parent, path.name).decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError:
        raise ModelError(
            expected="UTF-8 text", at=Place(path), remedy="train or copy the model again"
        ) from None
    stated = stated_format(text)
    if stated is not None and stated > FORMAT:
        raise ModelError(
            f"format {stated} is newer than format {FORMAT}, the newest that this version of pisigma reads",
            value=stated,
            at=Place(path, column="format"),
            remedy="upgrade pisigma",
        )
    signed = _CHECKSUM.fullmatch(text)
    if not signed or _digest(signed[1]) != signed[2]:
        raise ModelError(
            "the file was truncated or edited, or is not a model of pisigma: its last line is not the checksum of the "
            "lines before it",
            expected="a checksum",
            at=Place(path),
            remedy="train or copy the model again",
        )
    return signed[1]


def stated_format(text: str) -> int | None:
    """Return the format number in the first line of a document; None if there is none."""
    stated = re.match(r"format: ([0-9]{1,9})\n", text)
    return int(stated[1]) if stated else None


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
