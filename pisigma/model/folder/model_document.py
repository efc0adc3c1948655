"""`model.yaml`: what it holds, and the checksum by which a truncated or edited one is told."""

import hashlib
import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, FiniteFloat, PlainValidator

from pisigma.files.errors import ModelError
from pisigma.files.model_files import read_model_file
from pisigma.files.yaml_file import Section, parse_yaml, yaml_text
from pisigma.joint_correction.feature import FeatureSection
from pisigma.joint_correction.registry import feature_section
from pisigma.measurement.sensors.sensor import OtherUnit
from pisigma.robot.robot_file import RobotDocument

FORMAT = 5
"""Of this version; folders of earlier formats are upgraded by `pisigma.model.folder.upgrade`."""
MOST_FACTORS, MOST_UNITS = 100, 1000
"""Of a product unit; of a network."""
_CHECKSUM = re.compile(r"(.*^)sha256: ([0-9a-f]{64})\n", re.DOTALL | re.MULTILINE)

_Vector = tuple[float, float, float]
_Frame = tuple[float, float, float, float, float, float]
"""x, y, z [m], roll, pitch, yaw [rad]."""
_Feature = Annotated[FeatureSection, PlainValidator(feature_section)]


class GroupSection(Section):
    """One joint group of the network: see `pisigma.network.correction_network.JointGroup`."""

    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    inputs: Annotated[tuple[str, ...], Field(min_length=1)]
    orders: Annotated[
        tuple[Annotated[int, Field(ge=1, le=MOST_FACTORS)], ...], Field(min_length=1, max_length=MOST_UNITS)
    ]
    reference: tuple[_Vector, _Vector, _Vector]


class LearnedSection(Section):
    """The joint correction of a hybrid calibration and the geometry that goes with it.

    Attributes:
        features: of the unit of order 1.
        orders: number of factors of every product unit.
        bases: per frame, of the hybrid's geometry.
        tools: per target.
    """

    features: Annotated[tuple[_Feature, ...], Field(max_length=MOST_UNITS)]
    orders: Annotated[tuple[Annotated[int, Field(ge=2, le=MOST_FACTORS)], ...], Field(max_length=MOST_UNITS)]
    bases: dict[str, _Frame]
    tools: dict[str, _Frame]


class UnknownsSection(Section):
    """What sensors of a kind had to find out of themselves; see `pisigma.measurement.sensors.sensor.UnknownGroup`."""

    name: str
    columns: tuple[str, ...] = Field(min_length=1)
    owners: tuple[str, ...] = Field(min_length=1)
    frames: tuple[str, ...] = ()
    angles: tuple[str, ...] = ()
    units: dict[str, OtherUnit] = Field(default_factory=dict)


class UncertaintySection(Section):
    """What the rows of the root of the covariance, which stands in the weights file, belong to, in their order.

    Attributes:
        unknowns: what the sensors had to find out about themselves, group by group.
        values: by group and owner, the unknowns in the owner's frame [m or rad]; empty in folders that were upgraded
            from a format without them.
        free: which parameters have a row in the root; the others' rows are 0. Behind them come all weights.
        features: names of the features whose weights these are: those of the learned part, and `products` for the
            products of inputs that its product units make up.
        prior_scale: see `pisigma.calibration.hybrid.uncertainty.PositionUncertainty`, as for the noise.
    """

    unknowns: tuple[UnknownsSection, ...] = ()
    values: dict[str, dict[str, tuple[FiniteFloat, ...]]] = Field(default_factory=dict)
    free: tuple[Annotated[int, Field(ge=0)], ...]
    features: Annotated[tuple[str, ...], Field(max_length=MOST_UNITS)]
    prior_scale: Annotated[float, Field(gt=0)]
    noise: dict[str, Annotated[FiniteFloat, Field(gt=0)]] = Field(default_factory=dict)


class ProvenanceSection(Section):
    """See `pisigma.model.calibrated_model.Provenance`."""

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
    """The whole of `model.yaml`, but for the checksum in its last line."""

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
    """Give the text of a document, but for its last two lines: see `write_document`."""
    return yaml_text({"format": FORMAT, **document})


def write_document(text: str, compiled_sha256: str | None, path: Path) -> None:
    """Write a document with the hash of `compiled.npz`, and as its last line the checksum of all before it.

    Args:
        text: from `document_text`.
        compiled_sha256: None where there is no such file.
        path: to write.
    """
    text = f"{text}compiled_sha256: {compiled_sha256 or 'null'}\n"
    path.write_text(f"{text}sha256: {_digest(text)}\n", encoding="utf-8", newline="\n")


def read_document(path: Path) -> ModelDocument:
    """Read the document and check it.

    Raises:
        ModelError: the file cannot be read, is of another format, truncated, edited, or no model's.
    """
    text = read_signed_text(path)
    stated = stated_format(text)
    if stated is not None and 1 <= stated < FORMAT:
        raise ModelError(
            f"{path}: format {stated} is of an earlier version; run `pisigma upgrade {path.parent}` once to read it."
        )
    return parse_yaml(text, ModelDocument, ModelError, source=str(path))


def read_signed_text(path: Path) -> str:
    """Read the lines before the checksum, of this format or an earlier one.

    Raises:
        ModelError: the file cannot be read, is of a newer format, truncated, edited, or no model's.
    """
    try:
        text = read_model_file(path.parent, path.name).decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError:
        raise ModelError(
            f"{path}: cannot be read (it is no UTF-8 text); train or copy the model again."
        ) from None
    stated = stated_format(text)
    if stated is not None and stated > FORMAT:
        raise ModelError(
            f"{path}: format {stated} is newer than this pisigma reads ({FORMAT}); upgrade pisigma."
        )
    signed = _CHECKSUM.fullmatch(text)
    if not signed or _digest(signed[1]) != signed[2]:
        raise ModelError(
            f"{path}: is truncated, was edited, or is no model of pisigma (its last line is not the "
            "checksum of the lines before it); train or copy the model again."
        )
    return signed[1]


def stated_format(text: str) -> int | None:
    """Give the format in the first line of a document; None where there is none."""
    stated = re.match(r"format: ([0-9]{1,9})\n", text)
    return int(stated[1]) if stated else None


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
