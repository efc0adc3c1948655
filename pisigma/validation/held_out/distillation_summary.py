"""The figures of a distilled model as one typed value: how far it is from the full solutions that it stands for.

A card, tables on the screen and JSON render it, and a model folder keeps it as the metrics of its model. Figures are in
millimetres and degrees.
"""

from pisigma.files.yaml_file import Section
from pisigma.validation.held_out.summary import AbstractSummary
from pisigma.validation.held_out.validation_figures import ErrorFigures


class ParentFigures(Section):
    """The model that was distilled; `sha256` is that of its `model.yaml`, where it was read from a folder."""

    name: str
    kind: str
    sha256: str


class JointRange(Section):
    """Smallest and largest nominal value of a joint among the poses; `unit` is "deg" or "mm"."""

    name: str
    unit: str
    lower: float
    upper: float


class RegionFigures(Section):
    """Where poses were drawn.

    Attributes:
        kind: "joints": between rows of joint values; or "box": the tool's position in a box.
        rows: number of these rows of joint values.
        box_mm: x_min, x_max, y_min, y_max, z_min, z_max of the tool in the base frame [mm].
        joints: ranges of the joint values.
    """

    kind: str
    rows: int
    box_mm: tuple[float, float, float, float, float, float]
    joints: tuple[JointRange, ...]


class PoseFigures(Section):
    """How many poses there were.

    Attributes:
        fitted: number of poses that the network was fitted to.
        held_out: number of poses that were neither fitted to nor chosen by.
        beyond_measured_share: share of the held-out poses beyond the joint values that the parent was measured at.
        inside_domain_share: share of the held-out poses that count as inside the domain.
        drawn: number of poses that were drawn for all of them.
        refused: number of the drawn poses that were not taken, by reason.
    """

    fitted: int
    held_out: int
    beyond_measured_share: float
    inside_domain_share: float
    drawn: int
    refused: dict[str, int]


class SizeFigures(Section):
    """A size of network that was tried.

    Attributes:
        orders: of the product units.
        harmonics: cycles a turn up to which a joint's value is an input.
        unknowns: number of weights and biases per joint.
        rms_mm: RMS of the tool's error over the poses for choosing [mm].
        kept: whether it was chosen.
    """

    orders: tuple[int, ...]
    harmonics: int
    unknowns: int
    rms_mm: float
    kept: bool


class DistilledErrors(Section):
    """Errors of the tool under the full model, with the joint values of three models.

    Attributes:
        nominal: of the nominal robot.
        distilled: of the distilled model.
        full: of the full solution.
    """

    nominal: ErrorFigures
    distilled: ErrorFigures
    full: ErrorFigures

    @property
    def models(self) -> dict[str, ErrorFigures]:
        """All three, by name."""
        return {"nominal": self.nominal, "distilled": self.distilled, "full": self.full}


class AbsoluteFigures(Section):
    """Mean, root mean square and maximum of absolute values."""

    mean: float
    rms: float
    max: float


class DistilledJoint(Section):
    """What the full solution adds to the values of a joint, and how far the network is from that; in `unit`."""

    name: str
    unit: str
    correction: AbsoluteFigures
    error: AbsoluteFigures


class DistillationSummary(AbstractSummary):
    """All figures of a distilled model.

    Attributes:
        parent: the model that was distilled.
        region: where poses were drawn.
        poses: how many there were.
        sizes: that were tried, in order.
        held_out: errors of the tool on held-out poses.
        joints: corrections and their errors on held-out poses.
        warnings: why the model should perhaps not be used, a sentence each.
        limitations: what the full solution has and the distilled model lacks, a sentence each.
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
