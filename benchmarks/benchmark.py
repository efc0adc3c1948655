"""The benchmark of kinematic calibration on public measurements of real arms.

`python benchmarks/benchmark.py run` fits every method to every split of every series, and stores errors of all held-out
rows in `benchmarks/results`; `--quick` runs the first fold of the first split of every series, and stores only in
`--out`. `page` writes the page of the documentation from the stored results. `data` lists the series and what is
missing; the files are looked for in `PISIGMA_DATA`. `rows SERIES SPLIT` prints the row numbers of a split as JSON.
Packages that need other versions run with another Python: `--python pybotics=PATH`.
"""

import argparse
import json
import sys
from pathlib import Path

from shared_benchmark.fits import fits_of
from shared_benchmark.methods import NAMES as METHODS
from shared_benchmark.methods import method_of
from shared_benchmark.page import write_page
from shared_benchmark.series import NAMES as SERIES
from shared_benchmark.series import series_of
from shared_benchmark.splits import SPLITS, folds_of
from shared_benchmark.store import RESULTS, errors_of, replace, tables_of


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
    """Run the chosen methods, print one line for each split, and store each when it is complete."""
    pythons = dict(one.split("=", 1) for one in options.python)
    for name in options.series:
        series = series_of(name)
        missing = series.missing()
        if missing is not None:
            print(f"{name}: {missing}", file=sys.stderr)
            continue
        splits = [split for split in series.splits if split in options.split]
        for split in splits[:1] if options.quick else splits:
            for method in map(method_of, options.method):
                if options.quick and method.slow:
                    continue
                python = pythons.get(method.name, sys.executable)
                new = tables_of(fits_of(series, split, method, python, 1 if options.quick else None))
                folder = options.out or (None if options.quick else RESULTS)
                if folder is not None:
                    replace(folder, new)
                status = "; ".join(dict.fromkeys(new[0]["status"].to_pylist()))
                errors = errors_of(new[1], name, split, method.name)
                error = f"{errors.rms:.4f} mm" if len(errors.row) else ""
                print(f"{name:10s} {split:14s} {method.name:14s} {error:12s} {status}", flush=True)


if __name__ == "__main__":
    main()
