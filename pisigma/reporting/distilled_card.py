"""Card of a distilled model, and its tables."""

from pathlib import Path

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.rendering import write_card
from pisigma.reporting.tables import Table, figure_text
from pisigma.validation.held_out.distillation_summary import DistillationSummary

_SIZES = ("orders", "harmonics", "unknowns per joint", "tool, RMS [mm]", "kept")
_STATISTICS = (("mean", "mean"), ("rms", "RMS"), ("max", "max"))


def write_distilled_card(model: CalibratedModel, summary: DistillationSummary, folder: Path) -> None:
    """Write the card into a model folder.

    Args:
        model: distilled model.
        summary: figures of the model.
        folder: model folder.
    """
    tables = {
        "sizes": size_table(summary),
        "corrections": correction_table(summary),
        "ranges": _range_table(summary),
    }
    write_card(folder, "distilled_card.md.j2", model=model, summary=summary, **tables)


def size_table(summary: DistillationSummary) -> Table:
    """Make a table of the network sizes that were tried."""
    rows = (
        (
            ", ".join(map(str, size.orders)),
            str(size.harmonics),
            str(size.unknowns),
            figure_text(size.rms_mm),
            "yes" if size.kept else "no",
        )
        for size in summary.sizes
    )
    return Table(_SIZES, tuple(rows))


def correction_table(summary: DistillationSummary) -> Table:
    """Make a table of the joints: corrections, and errors of the network."""
    head = [f"{what}: {label}" for what in ("correction", "error") for _, label in _STATISTICS]
    rows = []
    for joint in summary.joints:
        figures = [getattr(part, name) for part in (joint.correction, joint.error) for name, _ in _STATISTICS]
        rows.append((joint.name, joint.unit, *(figure_text(value) for value in figures)))
    return Table(("joint", "unit", *head), tuple(rows))


def _range_table(summary: DistillationSummary) -> Table:
    """Make a table of the joints: smallest and largest nominal value among the poses."""
    joints = summary.region.joints
    rows = ((joint.name, joint.unit, figure_text(joint.lower), figure_text(joint.upper)) for joint in joints)
    return Table(("joint", "unit", "lowest", "highest"), tuple(rows))
