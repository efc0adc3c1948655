"""The verdict on a calibration: one sentence, and what it rests on."""

from collections.abc import Mapping
from dataclasses import dataclass

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.page.accuracy import Accuracy
from pisigma.reporting.page.judged_rows import JudgedRows
from pisigma.reporting.page.limits import Limit
from pisigma.reporting.page.worst_place import worst_place
from pisigma.reporting.tables import figure_text


@dataclass(frozen=True)
class Verdict:
    """What there is to say first.

    Attributes:
        sentence: how accurate, how much better than nominal, where worst, what limits it.
        tiles: the figures of it: what, figure, remark.
        worst: where it is worst, in a sentence.
        limit: what limits it, in a sentence.
        held_out: whether the sentence rests on rows that the model never saw.
    """

    sentence: str
    tiles: tuple[tuple[str, str, str], ...]
    worst: str
    limit: str
    held_out: bool


def verdict_of(
    model: CalibratedModel, accuracies: tuple[Accuracy, ...], rows: JudgedRows | None, limit: Limit
) -> Verdict:
    """Put the verdict together.

    Args:
        model: the model.
        accuracies: the first one counts.
        rows: judged rows, or None.
        limit: what limits the accuracy.
    """
    if not accuracies:
        return _without_poses(model)
    best = accuracies[0]
    clause, worst = worst_place(model, rows)
    parts = [_how_accurate(model, best)]
    parts += [clause] if clause else []
    parts += [f"what limits it is {limit.clause}"] if best.quantity[0] == "mm" else []
    tiles = _tiles(best)
    if limit.share is not None and limit.noise is not None:
        remark = f"of the squared error; {figure_text(limit.noise)} mm RMS"
        tiles.append(("scatter of a measurement", f"{100 * limit.share:.0f} %", remark))
    return Verdict(f"{'; '.join(parts)}.", tuple(tiles), worst, limit.sentence, best.held_out)


def _how_accurate(model: CalibratedModel, best: Accuracy) -> str:
    unit, quantity = best.quantity
    rms, p95, largest = (figure_text(best.last[f"{name}_{unit}"]) for name in ("rms", "p95", "max"))
    whose = "that it never saw" if best.held_out else "that it was made of"
    if best.reference:
        return (
            f"On {best.rows} poses {whose}, {model.name} keeps the tool to {rms} {unit} RMS (95 % within {p95}, all "
            f"within {largest}) at {best.reference}"
        )
    text = (
        f"On {best.rows} rows {whose}, {model.name} predicts the {quantity} to {rms} {unit} RMS (95 % within {p95}, "
        f"all within {largest})"
    )
    if best.factor is None:
        return text
    nominal = figure_text(best.models["nominal"][f"rms_{unit}"])
    if best.factor >= 1:
        return f"{text}, {best.factor:.1f} times better than the nominal robot ({nominal} {unit})"
    return (
        f"{text}, {1 / best.factor:.1f} times worse than the nominal robot ({nominal} {unit}): check that the rows are "
        "in the frame and of the target that the model was fitted to"
    )


def _tiles(best: Accuracy) -> list[tuple[str, str, str]]:
    unit, quantity = best.quantity
    rms, p95, largest = (
        f"{figure_text(best.last[f'{name}_{unit}'])} {unit}" for name in ("rms", "p95", "max")
    )
    tiles = [
        (f"{quantity}, RMS", rms, f"{best.rows} rows, {best.title}"),
        ("95 % within", p95, f"largest {largest}"),
    ]
    if best.factor is not None:
        nominal = f"nominal {figure_text(best.models['nominal'][f'rms_{unit}'])} {unit} RMS"
        better, times = ("better", best.factor) if best.factor >= 1 else ("worse", 1 / best.factor)
        tiles.append((f"{better} than nominal", f"{times:.1f} ×", nominal))
    if "rms_deg" in best.last and unit == "mm":
        turned, most = (f"{figure_text(best.last[f'{name}_deg'])} deg" for name in ("rms", "max"))
        tiles.append(("orientation, RMS", turned, f"largest {most}"))
    return tiles


def _without_poses(model: CalibratedModel) -> Verdict:
    """What joint errors say where no pose was judged."""
    joints = model.metrics.get("joints") or ()
    if not joints or "training" not in joints[0]:
        return Verdict(
            f"{model.name} holds no figures of its accuracy, and no measurements were given: nothing can be said of "
            "how accurate it is.",
            (), "", "Give a file with measurements that the model was not made of.", False,
        )  # fmt: skip
    part = "held_out" if "held_out" in joints[0] else "training"
    worst = max(joints, key=lambda joint: _average(joint[part]["after"]))
    before, after = (_average(worst[part][when]) for when in ("before", "after"))
    unit = next(iter(worst[part]["after"])).rsplit("_", 1)[1]
    whose = "On rows that it never saw" if part == "held_out" else "On the very rows that it was made of"
    factor = (
        f", {before / after:.0f} times better than nominal ({figure_text(before)} {unit})"
        if after > 0
        else ""
    )
    sentence = (
        f"{whose}, {model.name} gives the joint values of poses to {figure_text(after)} {unit} on average at its worst "
        f"joint, {worst['name']}{factor}; no pose errors were judged, so nothing is known of a measured robot."
    )
    tiles = (
        (
            f"worst joint, {worst['name']}",
            f"{figure_text(after)} {unit}",
            f"average, {part.replace('_', '-')} rows",
        ),
    )
    return Verdict(
        sentence, tiles, "", "Give a file with measured positions or poses to judge them.", part == "held_out"
    )


def _average(figures: Mapping[str, float]) -> float:
    return next(value for name, value in figures.items() if name.startswith("average"))
