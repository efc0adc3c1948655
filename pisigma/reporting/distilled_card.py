"""The card of a distilled model."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pisigma.reporting.tables import CARD, figure_text, markdown_table, pose_table, use_text
from pisigma.workflow.distillation import Distillation

_SIZES = ("orders", "harmonics", "unknowns per joint", "tool, RMS [mm]", "kept")
_FIGURES = tuple(f"{name}_{what}" for name in ("correction", "error") for what in ("mean", "rms", "max"))


def write_distilled_card(found: Distillation, command: str, report: Mapping[str, Any], folder: Path) -> None:
    """Write the card into a model folder.

    Args:
        found: the distillation.
        command: the command line that makes this model.
        report: from `report_distillation`.
        folder: where to write.
    """
    (folder / CARD).write_text(_text(found, command, report), encoding="utf-8")


def size_rows(sizes: Sequence[Mapping[str, Any]]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Names of the columns and the rows of what was tried."""
    rows: list[tuple[str, ...]] = [
        (
            ", ".join(map(str, size["orders"])),
            str(size["harmonics"]),
            str(size["unknowns"]),
            figure_text(size["rms_mm"]),
            "yes" if size["kept"] else "no",
        )
        for size in sizes
    ]
    return _SIZES, rows


def joint_rows(joints: Sequence[Mapping[str, Any]]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Names of the columns and the rows of the joints: what is added to them, and how far that is from the full."""
    head = ("joint", "unit", *(name.replace("_", ": ").replace("rms", "RMS") for name in _FIGURES))
    rows = [
        (
            joint["name"],
            joint["unit"],
            *(figure_text(joint[f"{name}_{joint['unit']}"]) for name in _FIGURES),
        )
        for joint in joints
    ]
    return head, rows


def _text(found: Distillation, command: str, report: Mapping[str, Any]) -> str:
    parent, model = report["parent"], found.model
    parts = [
        f"# {model.name}",
        f"Direct inverse corrector of robot {model.robot.name}, distilled from the model `{parent['name']}` "
        f"({parent['kind'].replace('_', ' ')}): a Pi-Sigma network that adds to nominal joint values what the full "
        "solution of that model would, for controllers that can only add an offset.",
        f"Made by `{command}`.",
        "## Region",
        _region_text(report),
        "## Error against the full solution",
        f"On {report['poses']['held_out']} poses of the region that were neither fitted to nor chosen by: where the "
        "tool comes to lie under the full calibrated model, from where it was wanted. Nominal is without correction.",
        pose_table(report["held_out"]),
        *(f"**Warning.** {sentence}" for sentence in report["doubts"]),
        "Absolute values per joint: what the full solution adds (correction), and what the network is off it (error).",
        markdown_table(*joint_rows(report["joints"])),
        "## Sizes tried",
        "The smallest that is about as good as the best is kept. Every joint has a network of product units of these "
        "orders on sines and cosines of the nominal joint values, and of up to so many times its own "
        "value (harmonics).",
        markdown_table(*size_rows(report["sizes"])),
        "## What it gives up",
        "\n".join(f"- {sentence}" for sentence in report["gives_up"]),
        "## Use",
        use_text(model.name),
        "The base and the tool of the nominal robot are those that the parent identified. `pisigma export MODEL "
        "--format onnx` gives it as a graph from nominal to corrected joint values.",
        "## Provenance",
        _provenance_text(found, report),
    ]
    return "\n\n".join(parts) + "\n"


def _region_text(report: Mapping[str, Any]) -> str:
    region, poses = report["region"], report["poses"]
    box = [f"{value:.1f}" for value in region["box_mm"]]
    bounds = ", ".join(f"{axis} {box[2 * i]} to {box[2 * i + 1]}" for i, axis in enumerate("xyz"))
    where = (
        f"Poses between {region['rows']} rows of joint values and their neighbours; the tool's positions are "
        f"{bounds} mm."
        if region["kind"] == "joints"
        else f"Tool positions {bounds} mm in the base frame, with orientations as at {region['rows']} rows of joint "
        "values and between them."
    )
    refused = ", ".join(f"{count} {reason}" for reason, count in poses["refused"].items() if count) or "none"
    beyond = poses["beyond_measured_share"]
    outside = (
        f" {beyond:.1%} of them lie beyond the joint values that the parent was measured at."
        if beyond
        else ""
    )
    table = markdown_table(
        ("joint", "unit", "lowest", "highest"),
        [(j["name"], j["unit"], figure_text(j["lower"]), figure_text(j["upper"])) for j in region["joints"]],
    )
    return (
        f"{where} {poses['fitted']} poses were fitted to; of {poses['drawn']} drawn, not taken: {refused}.{outside} "
        f"{poses['inside_domain_share']:.1%} of the held-out ones count as inside the domain. Nominal joint values:"
        f"\n\n{table}"
    )


def _provenance_text(found: Distillation, report: Mapping[str, Any]) -> str:
    provenance, parent = found.model.provenance, report["parent"]
    versions = ", ".join(f"{name} {value}" for name, value in provenance.versions.items())
    return "\n".join(
        [
            f"- parent `{parent['name']}`, sha256 of its `model.yaml` `{parent['sha256']}`",
            f"- branches: {', '.join(f'`{name}`' for name in found.model.branches) or 'numeric inverse'}",
            f"- seed {provenance.seed}; {versions}",
        ]
    )
