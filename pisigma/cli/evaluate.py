"""`pisigma evaluate`: how well a model explains measurements that it was not trained on."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pisigma.measurement.dataset import Measurements


def evaluate(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    data: Annotated[
        Path, typer.Argument(help="Measurements (CSV), in the frame that the model was fitted in.")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare a model with and without its correction on measurements.

    Rows of the set "train" are left out where the file has a column "set".
    """
    from pisigma.cli.output import print_json, print_table
    from pisigma.correction.model_folder import load_model
    from pisigma.evaluation.pose_statistics import compare_on
    from pisigma.evaluation.tables import pose_rows
    from pisigma.measurement.dataset import Measurements

    loaded = load_model(model)
    everything = Measurements.read_csv(data, loaded.robot)
    measurements = _unseen(everything)
    comparison = compare_on(loaded, measurements)
    trained_on = loaded.provenance.data_sha256 in (everything.content_hash(), measurements.content_hash())
    figures = comparison.in_file_units()
    result = {
        "model": str(model),
        "data": str(data),
        "rows": measurements.rows,
        "rows_not_predicted": comparison.not_predicted,
        "trained_on": trained_on,
        **figures,
    }
    if as_json:
        print_json(result)
        return
    print_table(f"errors of {measurements.rows} rows of {data}", *pose_rows(figures))
    if comparison.not_predicted:
        typer.echo(
            f"{comparison.not_predicted} rows lie so far outside the domain that the model predicts "
            "nothing; they are left out of both lines."
        )
    if trained_on:
        typer.echo("The model was trained on these rows: the figures say nothing about other poses.")


def _unseen(measurements: "Measurements") -> "Measurements":
    """The rows that may be judged.

    Raises:
        MeasurementError: the column `set` leaves no row for tests.
    """
    import torch

    from pisigma.errors import MeasurementError

    if measurements.split is None:
        return measurements
    test = torch.tensor([name == "test" for name in measurements.split])
    if not test.any():
        raise MeasurementError(
            f"{measurements.source}: column 'set' marks all rows as 'train'; mark some as 'test' or remove "
            "the column."
        )
    return measurements.select(test)
