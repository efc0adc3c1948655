"""What is said in sentences of rows that a calibration never saw."""

from collections.abc import Mapping
from typing import Any

from pisigma.reporting.hybrid_card import compared
from pisigma.reporting.tables import figure_text


def folds_text(found: Mapping[str, Any]) -> str:
    """How the rows of a validation were held out, such as "6 folds, dealt 8 times"."""
    return "held out once" if found.get("folds", 1) == 1 else f"{found['folds']} folds{_dealt(found)}"


def cross_validation_text(found: Mapping[str, Any]) -> str:
    """The same as a sentence, such as "6-fold cross-validation, dealt 8 times: each of 720 rows is ..."."""
    return (
        f"{found['folds']}-fold cross-validation{_dealt(found)}: each of {found['rows']} rows is judged by a "
        "calibration that never saw it"
    )


def _dealt(found: Mapping[str, Any]) -> str:
    return f", dealt {found['repeats']} times" if "repeats" in found else ""


def held_out_lines(found: Mapping[str, Any]) -> list[str]:
    """What else a cross-validation says, in sentences: of its repeats, of sockets and frames held out whole."""
    lines = []
    if "rms_mm_of_repeats" in found:
        ranges = ", ".join(
            f"{name} {figure_text(min(rms))} to {figure_text(max(rms))} mm"
            for name, rms in found["rms_mm_of_repeats"].items()
        )
        lines.append(
            f"RMS position errors of the {found['repeats']} repeats by themselves: {ranges}: so much depends on "
            "which joint values are held out together."
        )
    if "sockets_held_out" in found:
        lines.append(
            f"{found['sockets_held_out']} sockets were held out whole; an error there is how far a row puts the ball "
            "from where the socket's rows put it on average."
        )
    if "socket_distance" in found:
        distance = found["socket_distance"]
        *others, (last, best) = compared(distance).items()
        beside = "; ".join(
            f"{name} {figure_text(sizes['mean_mm'])} and {figure_text(sizes['max_mm'])} mm"
            for name, sizes in others
        )
        by = f" by the {last} calibration" if last != "geometric" else ""
        lines.append(
            f"The known distance of held-out sockets ({distance['count']} of them) is met to "
            f"{figure_text(best['mean_mm'])} mm on average, {figure_text(best['max_mm'])} mm at worst{by} ({beside})."
        )
    if "rows_not_judged" in found:
        lines.append(
            f"{found['rows_not_judged']} rows could not be judged: no row that was calibrated with had their target or "
            "anchor."
        )
    if "frames_fitted" in found:
        lines.append(
            f"{found['frames_fitted']} frames were held out whole; where the base stands in them, and nothing else, "
            "was fitted to the held-out rows."
        )
    return lines
