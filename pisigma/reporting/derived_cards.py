"""Cards of recalibrated, distilled and fleet models and of those with calibrated frames, and their tables."""

from pathlib import Path

from pisigma.lifetime.fleet.prior_summary import FleetPriorSummary
from pisigma.lifetime.recalibration.summary import RecalibrationSummary
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_posterior import FLEET_PRIOR
from pisigma.reporting.frame_text import (
    CAUSE_TITLE,
    cause_sentence,
    cause_table,
    coordinate_table,
    coordinate_title,
    fit_lines,
)
from pisigma.reporting.rendering import write_card
from pisigma.reporting.result_text import Table
from pisigma.reporting.tables import number_text
from pisigma.reporting.verdict import rounded_text
from pisigma.validation.held_out.distillation_summary import DistillationSummary
from pisigma.validation.held_out.frame_calibration_summary import FrameCalibrationSummary

_CANDIDATES = {
    "recalibrated": "recalibrated",
    "old": "old, with base and tool of these rows",
    "scratch": "from scratch",
}
_OF_FLEET = _CANDIDATES | {"recalibrated": "fleet and these rows", "old": "mean robot of the fleet"}


def write_recalibration_card(model: CalibratedModel, summary: RecalibrationSummary, folder: Path) -> None:
    """Write the card of a recalibrated model into the model folder.

    Args:
        model: model of the folder.
        summary: figures of the recalibration.
        folder: model folder.
    """
    write_card(
        folder, "recalibration_card.md.j2", model=model, summary=summary, candidates=candidate_table(summary)
    )


def write_frame_card(model: CalibratedModel, summary: FrameCalibrationSummary, folder: Path) -> None:
    """Write the card of a model with a calibrated frame or tool into the model folder.

    Args:
        model: model of the folder.
        summary: figures of the calibrated frames.
        folder: model folder.
    """
    write_card(
        folder, "frame_card.md.j2", model=model, summary=summary, title=coordinate_title(summary),
        coordinates=coordinate_table(summary), lines=[*fit_lines(summary), *cause_sentence(summary)],
        causes=cause_table(summary), cause_title=CAUSE_TITLE,
    )  # fmt: skip


def candidate_names(summary: RecalibrationSummary) -> dict[str, str]:
    """Return the names of the candidates by their keys in the figures."""
    return _OF_FLEET if summary.parent.kind == FLEET_PRIOR else _CANDIDATES


def candidate_table(summary: RecalibrationSummary) -> Table:
    """Return a table of the candidates: RMS error of held-out rows, and which candidate was chosen."""
    names = candidate_names(summary)
    rows = (
        (
            names[name],
            "too few rows"
            if errors.rms_mm is None
            else rounded_text(errors.rms_mm, summary.held_out_row_count),
            "yes" if name == summary.kept_candidate else "no",
        )
        for name, errors in summary.cross_validation.items()
    )
    return Table(("model", "held-out rows, RMS [mm]", "kept"), tuple(rows))


_SIZES = ("orders", "harmonics", "unknowns per joint", "tool, RMS [mm]", "kept")
_STATISTICS = (("mean", "mean"), ("rms", "RMS"), ("max", "max"))


def write_distilled_card(model: CalibratedModel, summary: DistillationSummary, folder: Path) -> None:
    """Write the card of a distilled model into the model folder.

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
    """Return a table of the network sizes that were tried."""
    rows = (
        (
            ", ".join(map(str, size.orders)),
            str(size.harmonics),
            str(size.unknowns),
            number_text(size.rms_mm),
            "yes" if size.is_selected else "no",
        )
        for size in summary.sizes
    )
    return Table(_SIZES, tuple(rows))


def correction_table(summary: DistillationSummary) -> Table:
    """Return a table of the joints: corrections, and errors of the network."""
    head = [f"{what}: {label}" for what in ("correction", "error") for _, label in _STATISTICS]
    rows = []
    for joint in summary.joints:
        figures = [getattr(part, name) for part in (joint.correction, joint.error) for name, _ in _STATISTICS]
        rows.append((joint.name, joint.unit, *(number_text(value) for value in figures)))
    return Table(("joint", "unit", *head), tuple(rows))


def _range_table(summary: DistillationSummary) -> Table:
    """Return a table of the joints: smallest and largest nominal value among the poses."""
    joints = summary.region.joints
    rows = ((joint.name, joint.unit, number_text(joint.lower), number_text(joint.upper)) for joint in joints)
    return Table(("joint", "unit", "lowest", "highest"), tuple(rows))


UNDETERMINED = (
    "A parameter that the rows do not determine, such as the position of the first axis in the base, has mean 0 and "
    "the usual standard deviation of the robot's class. Parameters in a sum, such as d_2 and d_3 of parallel axes, "
    "move the tool in the same way as one another, or as base or tool, so only their sum is determined."
)


def write_fleet_prior_card(model: CalibratedModel, summary: FleetPriorSummary, folder: Path) -> None:
    """Write the card of a fleet prior into the model folder.

    Args:
        model: mean robot.
        summary: figures of the prior.
        folder: model folder.
    """
    write_card(
        folder,
        "fleet_prior_card.md.j2",
        model=model,
        summary=summary,
        parameters=common_error_table(summary),
        undetermined=UNDETERMINED,
        spectrum=weight_spread_table(summary),
    )


def common_error_table(summary: FleetPriorSummary) -> Table:
    """Return a table of the mean and the standard deviation between robots of every geometric parameter."""
    rows = (
        (
            one.name,
            one.unit,
            f"{one.mean:z.4f}",
            f"{one.sigma:.4f}",
            "in a sum" if one.is_determined_only_in_sum else "",
        )
        for one in summary.parameters
    )
    return Table(("parameter", "unit", "mean", "between robots", "remark"), tuple(rows))


def weight_spread_table(summary: FleetPriorSummary) -> Table:
    """Return a table of standard deviations between robots of the weights of the joint correction, by group."""
    return Table(
        ("weights", "between robots [deg]"),
        tuple((one.group, f"{one.sigma_deg:.5f}") for one in summary.spectrum),
    )
