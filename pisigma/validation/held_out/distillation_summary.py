"""Figures of a distilled model as one typed value: its deviations from the full solutions that it approximates.

Cards, terminal tables and JSON are made from it, and a model folder stores it as metrics. Figures are in millimetres
and degrees.
"""

from typing import Annotated

from pydantic import Field

from pisigma.files.yaml_file import Section, StoredFigures
from pisigma.validation.held_out.summary import AbstractSummary
from pisigma.validation.held_out.validation_figures import ErrorFigures


class ParentFigures(Section):
    """The model that was distilled; `sha256` is the hash of its `model.yaml` if it was read from a folder."""

    name: str
    kind: str
    sha256: str


class JointRange(Section):
    """Smallest and largest nominal value of a joint over the poses; `unit` is "deg" or "mm"."""

    name: str
    unit: str
    lower: float
    upper: float


class RegionFigures(Section):
    """Region in which poses were drawn.

    Attributes:
        kind: "joints" for interpolated rows of joint values, or "box" for tool positions in a box.
        rows: number of these rows of joint values.
        box_mm: x_min, x_max, y_min, y_max, z_min, z_max of the tool in the frame of the measurements [mm].
        joints: ranges of the joint values.
    """

    kind: str
    rows: int
    box_mm: tuple[float, float, float, float, float, float]
    joints: tuple[JointRange, ...]


class PoseFigures(Section):
    """Numbers of poses that were drawn, fitted and held out.

    Attributes:
        fitted: number of poses that the network was fitted to.
        held_out: number of held-out poses, used neither for fitting nor for selection.
        beyond_measured_share: share of the held-out poses outside the joint ranges measured for the parent model.
        inside_domain_share: share of the held-out poses inside the domain.
        drawn: number of poses that were drawn in total.
        refused: number of drawn poses that were rejected, by reason.
    """

    fitted: int
    held_out: int
    beyond_measured_share: float
    inside_domain_share: float
    drawn: int
    refused: dict[str, int]


class SizeFigures(StoredFigures):
    """A network size that was tried.

    Attributes:
        orders: orders of the product units.
        harmonics: highest harmonic of a joint's value among the inputs [1/turn].
        unknowns: number of weights and biases per joint.
        rms_mm: RMS error of the tool over the validation poses [mm].
        is_selected: whether this size was selected.
    """

    orders: tuple[int, ...]
    harmonics: int
    unknowns: int
    rms_mm: float
    is_selected: Annotated[bool, Field(alias="kept")]


class DistilledErrors(Section):
    """Errors of the tool under the full model, with the joint values of three models.

    Attributes:
        nominal: errors of the nominal robot.
        distilled: errors of the distilled model.
        full: errors of the full solution.
    """

    nominal: ErrorFigures
    distilled: ErrorFigures
    full: ErrorFigures

    @property
    def models(self) -> dict[str, ErrorFigures]:
        """Errors of all three models, by name."""
        return {"nominal": self.nominal, "distilled": self.distilled, "full": self.full}


class AbsoluteErrorFigures(Section):
    """Mean, root mean square and maximum of absolute values."""

    mean: float
    rms: float
    max: float


class DistilledJoint(Section):
    """Correction of a joint by the full solution, and error of the network's approximation, in `unit`."""

    name: str
    unit: str
    correction: AbsoluteErrorFigures
    error: AbsoluteErrorFigures


class DistillationSummary(AbstractSummary):
    """All figures of a distilled model.

    Attributes:
        parent: the model that was distilled.
        region: region in which poses were drawn.
        poses: numbers of poses.
        sizes: sizes that were tried, in order.
        held_out: errors of the tool on held-out poses.
        joints: corrections and their errors on held-out poses.
        warnings: reasons why the model may be unsuitable, one sentence each.
        limitations: features of the full solution that the distilled model lacks, one sentence each.
    """

    kinds = ("distilled",)

    parent: ParentFigures
    region: RegionFigures
    poses: PoseFigures
    sizes: tuple[SizeFigures, ...]
    held_out: DistilledErrors
    joints: tuple[DistilledJoint, ...]
    warnings: tuple[str, ...] = ()
    limitations: tuple[str, ...] = ()
