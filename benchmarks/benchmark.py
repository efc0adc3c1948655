"""The benchmark of kinematic calibration on public measurements of real arms.

`python benchmarks/benchmark.py run` fits every method to every split of every series, and stores errors of all held-out
rows in `benchmarks/results`; splits that are stored there with the same hashes of data, split and code are not run
again. `--quick` runs the first fold of the first split of every series, and stores only in `--out`. `page` writes the
page of the documentation from the stored results. `data` lists the series and the missing files, which are searched for
in `PISIGMA_DATA`. `rows SERIES SPLIT` prints the row numbers of a split as JSON. Packages that need other versions run
with another Python: `--python pybotics=PATH`.
"""

import argparse
import json
import math
import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from shared_benchmark.fits import fits_of, inputs_of, overrun_rows
from shared_benchmark.methods import NAMES as METHODS
from shared_benchmark.methods import method_of
from shared_benchmark.page import write_page
from shared_benchmark.public_series import Series
from shared_benchmark.rows import Method
from shared_benchmark.series import NAMES as SERIES
from shared_benchmark.series import series_of
from shared_benchmark.splits import SPLITS, folds_of
from shared_benchmark.store import RESULTS, errors_of, replace, stored_fits, tables_of

STORING = threading.Lock()


def main() -> None:
    """Read the command and run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="Fit, predict and store")
    run.add_argument("--series", choices=SERIES, nargs="+", default=SERIES)
    run.add_argument("--split", choices=SPLITS, nargs="+", default=list(SPLITS))
    run.add_argument("--method", choices=METHODS, nargs="+", default=METHODS)
    run.add_argument(
        "--python", action="append", default=[], metavar="METHOD=PATH", help="Python of a method"
    )
    run.add_argument(
        "--quick", action="store_true", help="Run the first fold of the first split of every series"
    )
    run.add_argument("--jobs", type=int, default=os.cpu_count(), help="Fits at the same time")
    run.add_argument("--out", type=Path, help="Folder of the results")
    page = commands.add_parser("page", help="Write the page from stored results")
    page.add_argument("--results", type=Path, default=RESULTS)
    commands.add_parser("data", help="List the series and what is missing")
    rows = commands.add_parser("rows", help="Print the row numbers of a split as JSON")
    rows.add_argument("series", choices=SERIES)
    rows.add_argument("split", choices=SPLITS)
    options = parser.parse_args()
    if options.command == "run":
        run_methods(options)
    elif options.command == "page":
        write_page(options.results)
    elif options.command == "data":
        for name in SERIES:
            series = series_of(name)
            print(f"{name:10s} {series.licence}, {series.citation}: {series.missing() or 'complete'}")
    else:
        folds = folds_of(series_of(options.series), options.split)
        json.dump([{"train": one.train.tolist(), "test": one.test.tolist()} for one in folds], sys.stdout)


def run_methods(options: argparse.Namespace) -> None:
    """Run the chosen methods, several at a time, and store each split when it is complete."""
    there = []
    for name in options.series:
        series = series_of(name)
        missing = series.missing()
        if missing is None:
            there.append(series)
        else:
            print(f"{name}: {missing}", file=sys.stderr)
    methods = sorted(map(method_of, options.method), key=lambda method: method.slow)
    pairs = [(series, method) for method in methods for series in there]
    with ThreadPoolExecutor(options.jobs) as pool:
        list(pool.map(lambda pair: run_splits(options, *pair), pairs))


def run_splits(options: argparse.Namespace, series: Series, method: Method) -> None:
    """Run a method on the splits of a series, with few training rows first, and print one line for each."""
    python = dict(one.split("=", 1) for one in options.python).get(method.name, sys.executable)
    folder = options.out or (None if options.quick else RESULTS)
    splits = [split for split in series.splits if split in options.split]
    if options.quick:
        splits = [] if method.slow else splits[:1]
    below = math.inf
    for split in sorted(splits, key=lambda split: len(folds_of(series, split)[0].train)):
        folds = 1 if options.quick else len(folds_of(series, split))
        with STORING:
            stored = folder and stored_fits(folder, inputs_of(series, split, method), folds)
        if stored:
            below = min(below, overrun_rows(stored))
            print(f"{series.name:10s} {split:14s} {method.name:15s} stored", flush=True)
            continue
        new = tables_of(fits_of(series, split, method, python, folds, below))
        below = min(below, overrun_rows(new[0].to_pylist()))
        status = "; ".join(dict.fromkeys(new[0]["status"].to_pylist()))
        errors = errors_of(new[1], series.name, split, method.name)
        error = f"{errors.rms:.4f} mm" if len(errors.row) else ""
        with STORING:
            if folder is not None:
                replace(folder, new)
            print(f"{series.name:10s} {split:14s} {method.name:15s} {error:12s} {status}", flush=True)


if __name__ == "__main__":
    main()
