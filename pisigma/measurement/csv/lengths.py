"""What the rows of a measurement file say of lengths."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from pisigma.measurement.csv.columns import ANCHOR_PLACE, quoted
from pisigma.measurement.csv.header import Layout
from pisigma.measurement.lengths import LengthCells


def length_cells(
    values: Float64[np.ndarray, "rows columns"], cells: list[Sequence[str]], layout: Layout
) -> LengthCells:
    """The cells of a file as the rules for lengths want them, in the file's units.

    Args:
        values: the numbers by column.
        cells: the texts by column.
        layout: what the header says.
    """
    rows = len(values)

    def numbers(quantity: str) -> Float64[np.ndarray, " rows"]:
        return values[:, layout.index[quantity]] if quantity in layout.index else np.full(rows, np.nan)

    def names(quantity: str) -> tuple[str, ...]:
        if quantity not in layout.index:
            return ("",) * rows
        return tuple(cell.strip() for cell in cells[layout.index[quantity]])

    labels = {quantity: f"column '{layout.column(quantity).name}'" for quantity in layout.index}
    for name, group in (("position", layout.position), ("anchor_place", ANCHOR_PLACE)):
        if set(group) <= set(layout.index):
            labels[name] = f"columns {quoted(layout.column(quantity) for quantity in group)}"
    labels["sigma"] = labels.get("sigma_position", "sigma_mm")
    position = np.zeros(rows, dtype=bool)
    if layout.position:
        position = ~np.isnan(np.stack([numbers(name) for name in layout.position], axis=1)).any(1)
    return LengthCells(
        labels=labels,
        frame=names("frame"),
        socket=names("socket"),
        touch_axis=names("touch_axis"),
        anchor=names("anchor"),
        pair=names("pair"),
        position=position,
        touch=numbers("touch"),
        distance=numbers("distance"),
        anchor_place=np.stack([numbers(name) for name in ANCHOR_PLACE], axis=1),
        sigma=numbers("sigma_position"),
    )
