"""The card of a distilled model, and its tables on card and screen."""

from pathlib import Path

from pisigma.judging.distillation_summary import DistillationSummary
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.tables import CARD, Table, figure_text, markdown_table, pose_table, use_text

_SIZES = ("orders", "harmonics", "unknowns per joint", "tool, RMS [mm]", "kept")
_STATISTICS = (("mean", "mean"), ("rms", "RMS"), ("max", "max"))


def write_distilled_card(model: CalibratedModel, summary: DistillationSummary, folder: Path) -> None:
    """Write the card into a model folder.

    Args:
        model: the distilled model.
        summary: its figures.
        folder: where to write.
    """
    (folder / CARD).write_text(_text(model, summary), encoding="utf-8")


def size_table(summary: DistillationSummary) -> Table:
    """One row per size that was tried."""
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
    """One row per joint: what is added to its values, and how far the network is from that."""
    head = [f"{what}: {label}" for what in ("correction", "error") for _, label in _STATISTICS]
    rows = []
    for joint in summary.joints:
        figures = [getattr(part, name) for part in (joint.correction, joint.error) for name, _ in _STATISTICS]
        rows.append((joint.name, joint.unit, *(figure_text(value) for value in figures)))
    return Table(("joint", "unit", *head), tuple(rows))


def _text(model: CalibratedModel, summary: DistillationSummary) -> str:
    parent = summary.parent
    sections = [
        f"# {model.name}",
        f"Direct inverse corrector of robot {model.robot.name}, distilled from the model `{parent.name}` "
        f"({parent.kind.replace('_', ' ')}): a Pi-Sigma network that adds to nominal joint values what the full "
        "solution of that model would, for controllers that can only add an offset.",
        f"Made by `{summary.command}`.",
        "## Region",
        _region_text(summary),
        "## Error against the full solution",
        f"On {summary.poses.held_out} poses of the region that were neither fitted to nor chosen by: where the "
        "tool comes to lie under the full calibrated model, from where it was wanted. Nominal is without correction.",
        pose_table(summary.held_out.models),
        *(f"**Warning.** {sentence}" for sentence in summary.warnings),
        "Absolute values per joint: what the full solution adds (correction), and what the network is off it (error).",
        markdown_table(*correction_table(summary)),
        "## Sizes tried",
        "The smallest that is about as good as the best is kept. Every joint has a network of product units of these "
        "orders on sines and cosines of the nominal joint values, and of up to so many times its own "
        "value (harmonics).",
        markdown_table(*size_table(summary)),
        "## What it gives up",
        "\n".join(f"- {sentence}" for sentence in summary.limitations),
        "## Use",
        use_text(model.name),
        "The base and the tool of the nominal robot are those that the parent identified. `pisigma export MODEL "
        "--format onnx` gives it as a graph from nominal to corrected joint values.",
        "## Provenance",
        _provenance_text(model, summary),
    ]
    return "\n\n".join(sections) + "\n"


def _region_text(summary: DistillationSummary) -> str:
    region, poses = summary.region, summary.poses
    box = [f"{value:.1f}" for value in region.box_mm]
    bounds = ", ".join(f"{axis} {box[2 * i]} to {box[2 * i + 1]}" for i, axis in enumerate("xyz"))
    where = (
        f"Poses between {region.rows} rows of joint values and their neighbours; the tool's positions are "
        f"{bounds} mm."
        if region.kind == "joints"
        else f"Tool positions {bounds} mm in the base frame, with orientations as at {region.rows} rows of joint "
        "values and between them."
    )
    refused = ", ".join(f"{count} {reason}" for reason, count in poses.refused.items() if count) or "none"
    outside = (
        f" {poses.beyond_measured_share:.1%} of the held-out ones lie beyond the joint values that the parent was "
        "measured at."
        if poses.beyond_measured_share
        else ""
    )
    table = markdown_table(
        ("joint", "unit", "lowest", "highest"),
        [
            (joint.name, joint.unit, figure_text(joint.lower), figure_text(joint.upper))
            for joint in region.joints
        ],
    )
    return (
        f"{where} {poses.fitted} poses were fitted to; of {poses.drawn} drawn, not taken: {refused}.{outside} "
        f"{poses.inside_domain_share:.1%} of the held-out ones count as inside the domain. Nominal joint values:"
        f"\n\n{table}"
    )


def _provenance_text(model: CalibratedModel, summary: DistillationSummary) -> str:
    versions = ", ".join(f"{name} {value}" for name, value in model.provenance.versions.items())
    return "\n".join(
        [
            f"- parent `{summary.parent.name}`, sha256 of its `model.yaml` `{summary.parent.sha256}`",
            f"- branches: {', '.join(f'`{name}`' for name in model.branches) or 'numeric inverse'}",
            f"- seed {model.provenance.seed}; {versions}",
        ]
    )
