"""`pisigma verify`: whether a correction is active, told from new measurements."""

from pathlib import Path
from typing import Annotated, Any

import typer


def verify(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    data: Annotated[
        Path,
        typer.Argument(help="New measurements (CSV) at the joint values that the robot was commanded to."),
    ],
    fit_frame: Annotated[
        bool, typer.Option("--fit-frame", help="The sensor was moved since: fit its frame to these rows.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Tell whether new measurements are explained better by the corrected model than by the nominal robot.

    Where errors are large, the usual setup faults that explain them are named: another frame or tool, units, order,
    signs or zeros of the joints, a correction that was applied twice or not at all. Rows of the set "train" are
    left out. Exit status 3 where the corrected model does not explain the measurements better.
    """
    from pisigma.cli.output import print_json
    from pisigma.cli.progress import progress_of
    from pisigma.errors import AcceptanceError
    from pisigma.model.folder.model_folder import load_model
    from pisigma.verification import verification

    loaded = load_model(model)
    measurements = verification.read_for_verification(data, loaded)
    with progress_of(f"verifying {model}") as tell:
        tell(f"{measurements.rows} rows")
        found = verification.verify(loaded, measurements, fit_frame=fit_frame)
    result: dict[str, Any] = {
        "model": str(model),
        "data": str(data),
        "rows": measurements.rows,
        "frame_fitted": fit_frame,
        "explained_better": found.verdict == "better",
        "verdict": found.verdict,
        "sentence": found.sentence,
        "ratio": found.ratio if found.ratio == found.ratio else None,
        "better_share": found.better_share,
        **found.comparison,
        "setup_faults": [setup_fault.in_file_units() for setup_fault in found.setup_faults],
        "remarks": list(found.remarks),
    }
    if as_json:
        print_json(result)
    else:
        _print(result)
    if found.verdict != "better":
        raise AcceptanceError(found.sentence)


def _print(result: dict[str, Any]) -> None:
    from pisigma.cli.output import print_table
    from pisigma.reporting.comparison_tables import comparison_table, difference_table

    confidence = f"{100 * result['bootstrap']['confidence']:.0f} %"
    rows = f"{result['rows_compared']} rows ({result['configurations']} configurations) of {result['data']}"
    print_table(f"errors of {rows}; in brackets {confidence} confidence", *comparison_table(result))
    print_table("difference to nominal on the same rows, below 0 is better", *difference_table(result))
    for setup_fault in result["setup_faults"]:
        typer.echo(setup_fault["sentence"])
    for remark in result["remarks"]:
        typer.echo(remark)
    if result["explained_better"]:
        typer.echo(result["sentence"])
