"""Joint offsets as CSV and YAML, with what they give up in the head."""

import csv
import io

import numpy as np
import yaml

from pisigma.export.dh_table import cells, file_values, head, in_units
from pisigma.export.joint_offsets import JointOffsets
from pisigma.robot.row import FRAME_COLUMNS

MEANING = (
    "The real robot commanded to q stands where the robot as drawn stands at q + offset: command q - offset, "
    "or put the offset into the controller's zero positions. Base and tool were fitted anew for this."
)


def offset_sentences(offsets: JointOffsets) -> tuple[str, ...]:
    """What the offsets mean and what they give up."""
    lost, nominal = offsets.lost.in_file_units(), offsets.nominal.in_file_units()
    said = [
        MEANING,
        f"Offsets alone are off the whole model by {lost['mean_mm']:.4g} mm in the mean, "
        f"{lost['p95_mm']:.4g} mm in 95 % of its poses, {lost['max_mm']:.4g} mm at most, and "
        f"{lost['mean_mrad']:.4g} mrad in the mean (the robot as drawn, on the model's base and tool: "
        f"{nominal['mean_mm']:.4g}, {nominal['p95_mm']:.4g}, {nominal['max_mm']:.4g} mm and "
        f"{nominal['mean_mrad']:.4g} mrad).",
    ]
    if offsets.unobservable:
        said.append(f"Base or tool take in the offset of {', '.join(offsets.unobservable)}, which is 0 here.")
    return tuple(said)


def offsets_csv(offsets: JointOffsets, comments: tuple[str, ...] = ()) -> str:
    """One line a joint, then base and tool; cells that do not apply are empty."""
    text = io.StringIO()
    frame = [in_units(name) for name in FRAME_COLUMNS]
    columns = ("part", "name", "type", "offset_deg", "offset_mm", *frame)
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    for entry in _joints(offsets):
        writer.writerow({"part": "joint", **entry})
    for part in ("base", "tool"):
        writer.writerow({"part": part, **cells(FRAME_COLUMNS, getattr(offsets.robot, part))})
    return head((*comments, *offset_sentences(offsets))) + text.getvalue()


def offsets_yaml(offsets: JointOffsets, comments: tuple[str, ...] = ()) -> str:
    """Offsets, base, tool and what they give up."""
    document: dict[str, object] = {"robot": offsets.robot.name, "joints": _joints(offsets)}
    for part in ("base", "tool"):
        values = file_values(FRAME_COLUMNS, getattr(offsets.robot, part))
        document[part] = {in_units(name): value for name, value in values.items()}
    document["off_the_whole_model"] = offsets.lost.in_file_units()
    document["robot_as_drawn"] = offsets.nominal.in_file_units()
    body = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    return head((*comments, *offset_sentences(offsets))) + body


def _joints(offsets: JointOffsets) -> list[dict[str, object]]:
    return [
        {"name": joint.name, "type": joint.type}
        | (
            {"offset_deg": float(np.rad2deg(value))}
            if joint.type == "revolute"
            else {"offset_mm": float(value * 1e3)}
        )
        for joint, value in zip(offsets.robot.joints, offsets.values, strict=True)
    ]
