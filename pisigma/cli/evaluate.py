"""`pisigma evaluate`: how well a model explains measurements that it was not trained on."""

import json
from pathlib import Path
from typing import Annotated

import typer


def evaluate(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    data: Annotated[Path, typer.Argument(help="Measurements (CSV), in the frame that the model was fitted in.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare a model with and without its correction on measurements."""
    from pisigma.correction.model_folder import load_model
    from pisigma.evaluation.pose_statistics import corrected_errors, nominal_errors
    from pisigma.measurement.dataset import Measurements

    loaded = load_model(model)
    measurements = Measurements.read_csv(data, loaded.robot)
    corrected = corrected_errors(loaded, measurements)
    result = {
        "model": str(model),
        "data": str(data),
        "rows": measurements.rows,
        "rows_not_predicted": int(corrected.position.isnan().sum()),
        "nominal": nominal_errors(loaded, measurements).in_file_units(),
        "corrected": corrected.in_file_units(),
    }
    if as_json:
        typer.echo(json.dumps(result))
        return
    from pisigma.cli.output import print_table

    names = ("nominal", "corrected")
    table = [(name, *(f"{value:.3f}" for value in result[name].values())) for name in names]
    print_table(f"{measurements.rows} rows of {data}", ("model", *(k.replace("_", " ") for k in result["nominal"])), table)
    if result["rows_not_predicted"]:
        typer.echo(f"{result['rows_not_predicted']} rows lie so far outside the domain that the model predicts nothing.")
