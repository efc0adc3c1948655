"""Stored results: one table of fits and one of held-out rows, as Parquet."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet

from shared_benchmark.fits import WAITED, Fit
from shared_benchmark.scores import RowErrors

RESULTS = Path(__file__).parents[1] / "results"
"""Folder of the results that the page of the documentation shows."""
KEY = ("series", "split", "method")
DECIMALS = 4
"""Decimals of stored errors [mm], which are 0.1 µm; the smallest noise of a series is about 10 µm."""
FITS = pa.schema(
    [(name, pa.string()) for name in KEY]
    + [("fold", pa.int32()), ("status", pa.string()), ("train_rows", pa.int32()), ("seconds", pa.float64())]
    + [
        ("elapsed_seconds", pa.float64()),
        ("memory_mb", pa.float64()),
        ("distance_mm", pa.float64()),
        ("versions", pa.string()),
        ("seed", pa.int32()),
    ]
    + [(name, pa.string()) for name in ("data_sha256", "split_sha256", "code_sha256")]
)
ROWS = pa.schema(
    [(name, pa.string()) for name in KEY]
    + [("fold", pa.int32()), ("row", pa.int32()), ("group", pa.int32())]
    + [(f"{what}_{axis}_mm", pa.float32()) for what in ("error", "sigma") for axis in "xyz"]
    + [("angle_deg", pa.float32())]
)


def tables_of(results: Iterable[tuple[Fit, RowErrors | None]]) -> tuple[pa.Table, pa.Table]:
    """Return the tables of fits and rows of some results."""
    fits: list[Fit] = []
    rows = [ROWS.empty_table()]
    for fit, errors in results:
        fits.append(fit)
        if errors is None:
            continue
        count = len(errors.row)
        columns: dict[str, Any] = {name: [fit[name]] * count for name in (*KEY, "fold")}
        columns |= {"row": errors.row, "group": errors.group, "angle_deg": errors.angle.round(DECIMALS)}
        for what, values in (("error", errors.error), ("sigma", errors.sigma)):
            rounded = values.round(DECIMALS)
            columns |= {f"{what}_{axis}_mm": rounded[:, k] for k, axis in enumerate("xyz")}
        arrays = [pa.array(columns[item.name]).cast(item.type) for item in ROWS]
        rows.append(pa.Table.from_arrays(arrays, schema=ROWS))
    return pa.Table.from_pylist(fits, FITS), pa.concat_tables(rows)


def read(folder: Path) -> tuple[pa.Table, pa.Table]:
    """Return the stored tables of fits and rows; they are empty if nothing is stored."""
    paths = folder / "fits.parquet", folder / "rows.parquet"
    fits, rows = (
        pyarrow.parquet.read_table(path, schema=schema) if path.is_file() else schema.empty_table()
        for path, schema in zip(paths, (FITS, ROWS), strict=True)
    )
    return fits, rows


def replace(folder: Path, new: tuple[pa.Table, pa.Table]) -> None:
    """Replace the stored results of the same series, splits and methods; all results are sorted by these."""
    folder.mkdir(parents=True, exist_ok=True)
    ran = {tuple(row[name] for name in KEY) for row in new[0].select(KEY).to_pylist()}
    for name, old, table in zip(("fits", "rows"), read(folder), new, strict=True):
        kept = [tuple(row.values()) not in ran for row in old.select(KEY).to_pylist()]
        order = [(column, "ascending") for column in (*KEY, "fold", *(["row"] if name == "rows" else []))]
        joined = pa.concat_tables([old.filter(pa.array(kept, pa.bool_())), table]).sort_by(order)
        path = folder / f"{name}.parquet"
        pyarrow.parquet.write_table(joined, path.with_suffix(".new"), compression="zstd", compression_level=9)
        path.with_suffix(".new").replace(path)


def stored_fits(folder: Path, inputs: Fit, folds: int) -> list[Fit] | None:
    """Return the stored fits of a series, split and method; None if one of them has to be run.

    Args:
        folder: folder of the results.
        inputs: series, split, method, hashes and seed, which decide the result.
        folds: number of folds of the split that are wanted.
    """
    fits = read(folder)[0].to_pylist()
    found = [fit for fit in fits if all(fit[name] == inputs[name] for name in inputs)]
    again = [fit for fit in found if fit["status"].startswith((WAITED, "not installed"))]
    complete = len(found) == folds or any(fit["status"].startswith("does not use") for fit in found)
    return found if complete and not again else None


def errors_of(rows: pa.Table, series: str, split: str, method: str) -> RowErrors:
    """Return the stored errors of a method, in the order of folds and rows."""
    field = pyarrow.compute.field
    wanted = (field("series") == series) & (field("split") == split) & (field("method") == method)
    chosen = rows.filter(wanted)
    columns = {name: chosen[name].to_numpy() for name in ROWS.names[len(KEY) :]}
    error, sigma = (
        np.stack([columns[f"{what}_{axis}_mm"] for axis in "xyz"], 1).astype(float)
        for what in ("error", "sigma")
    )
    row, group, fold, angle = (columns[name] for name in ("row", "group", "fold", "angle_deg"))
    return RowErrors(row, group, fold, error, sigma, angle.astype(float))
