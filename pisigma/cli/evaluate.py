"""`pisigma evaluate`: how well models explain measurements that they were not trained on."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from pisigma.measurement.dataset import Measurements
    from pisigma.model.calibrated_model import CalibratedModel

REFERENCES = ("nominal", "geometric")
"""Words for what a model is compared with; neither has to meet limits."""


def evaluate(
    paths: Annotated[
        list[str],
        typer.Argument(
            metavar="MODEL... DATA",
            help="Model folders, and 'nominal' (the robot as drawn, base and tool fitted) or 'geometric' (what a "
            "hybrid builds upon) of the first that has it; last, measurements (CSV) in the frames that they were "
            "fitted in. A single model is compared with nominal.",
        ),
    ],
    max_mean_mm: Annotated[
        float | None, typer.Option(help="Accept only where the mean position error is at most this.")
    ] = None,
    max_p95_mm: Annotated[
        float | None, typer.Option(help="Accept only where 95 % of the position errors are at most this.")
    ] = None,
    max_mm: Annotated[
        float | None, typer.Option(help="Accept only where no position error is larger.")
    ] = None,
    max_mean_deg: Annotated[
        float | None, typer.Option(help="Accept only where the mean orientation error is at most this.")
    ] = None,
    fit_frame: Annotated[
        bool, typer.Option("--fit-frame", help="The sensor was moved since: fit its frame to these rows.")
    ] = False,
    resamples: Annotated[
        int, typer.Option(min=2, help="Of the configurations, for confidence intervals.")
    ] = 2000,
    seed: Annotated[int, typer.Option(help="Of the resamples.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare models on measurements, with confidence intervals, and accept them or not.

    Rows of the set "train" are left out where the file has a column "set". With a limit, every model folder has to
    meet it, else the exit status is 3.
    """
    from pisigma.cli.output import print_json
    from pisigma.errors import AcceptanceError
    from pisigma.judging.acceptance import Limits
    from pisigma.judging.bootstrap import Bootstrap
    from pisigma.judging.model_comparison import compare_models
    from pisigma.reporting.comparison_report import report_comparison

    if len(paths) < 2:
        raise typer.BadParameter("a model folder and, last, a file of measurements were wanted.")
    limits = Limits(max_mean_mm, max_p95_mm, max_mm, max_mean_deg)
    names, data = paths[:-1], Path(paths[-1])
    loaded = _load(names)
    short = _labels(names)
    everything, measurements = _read(data, next(iter(loaded.values())))
    models = _with_references(names, loaded, measurements.rotation is not None)
    compared = {short.get(name, name): model for name, model in models.items()}
    bootstrap = Bootstrap(resamples, seed)
    report = report_comparison(compare_models(compared, measurements, bootstrap, fit_frame))
    hashes = everything.content_hash(), measurements.content_hash()
    missed = []
    for name, figures in zip(models, report["models"], strict=True):
        if (model := loaded.get(name)) is not None:
            trained_on = model.provenance.data_sha256 in hashes
            figures |= {"model": name, "kind": model.kind, "trained_on": trained_on}
            missed += limits.missed(figures)
    result: dict[str, Any] = {
        "data": str(data),
        "rows": measurements.rows,
        "frame_fitted": fit_frame,
        **report,
    }
    if limits.given:
        result |= {"limits": limits.given, "accepted": not missed, "missed": missed}
    if as_json:
        print_json(_with_single(result, names))
    else:
        _print(result)
    if missed:
        raise AcceptanceError(f"not accepted: {'; '.join(missed)}.")


def _load(names: list[str]) -> "dict[str, CalibratedModel]":
    """The models of the folders that are given, by what they were called."""
    from pisigma.errors import ModelError
    from pisigma.model.folder.model_folder import load_model

    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ModelError(f"{twice} is given twice; give every model once.")
    loaded = {name: load_model(name) for name in names if name not in REFERENCES}
    if not loaded:
        raise ModelError(
            f"'{' '.join(names)}' is not enough, as it is found from a model; give a model folder besides (a folder "
            f"of that name as ./{names[0]})."
        )
    return loaded


def _read(data: Path, model: "CalibratedModel") -> "tuple[Measurements, Measurements]":
    """All rows of a file, and those that may be judged.

    Raises:
        MeasurementError: the file cannot be used, or the column `set` leaves no row for tests.
    """
    import torch

    from pisigma.errors import MeasurementError
    from pisigma.measurement.dataset import Measurements

    measurements = Measurements.read_csv(data, model.robot)
    if measurements.split is None:
        return measurements, measurements
    test = torch.tensor([name == "test" for name in measurements.split])
    if not test.any():
        raise MeasurementError(
            f"{measurements.source}: column 'set' marks all rows as 'train'; mark some as 'test' or remove "
            "the column."
        )
    return measurements, measurements.select(test)


def _with_references(
    names: list[str], loaded: "dict[str, CalibratedModel]", turned: bool
) -> "dict[str, CalibratedModel]":
    """All models by name, in the order in which they were given; nominal before a single one."""
    from pisigma.judging.reference_models import geometric_model, nominal_model

    first = next(iter(loaded.values()))
    identified = next((model for model in loaded.values() if model.calibrated is not None), first)
    found = {}
    for name in ["nominal", *names] if len(names) == 1 else names:
        if name == "nominal":
            found[name] = nominal_model(first, turned)
        else:
            found[name] = geometric_model(identified) if name == "geometric" else loaded[name]
    return found


def _labels(names: list[str]) -> dict[str, str]:
    """What tables call the models: the folder's own name, or all that was given where two have the same."""
    own = {name: Path(name).resolve().name for name in names if name not in REFERENCES}
    taken = [*own.values(), *REFERENCES]
    return {name: label if taken.count(label) == 1 else name for name, label in own.items()}


def _with_single(result: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """The result with the figures of a single model at hand, beside the list of all models."""
    if len(names) > 1:
        return result
    nominal, model = (
        {key: value for key, value in model.items() if key.endswith(("_mm", "_deg"))}
        for model in result["models"]
    )
    own = result["models"][1]
    counts = {"rows_not_predicted": own["rows_not_predicted"], "trained_on": own["trained_on"]}
    return {"model": names[0], **result, **counts, "nominal": nominal, "corrected": model}


def _print(result: dict[str, Any]) -> None:
    from pisigma.cli.output import print_table
    from pisigma.judging.moved_frames import FITTED
    from pisigma.reporting.comparison_tables import comparison_table, difference_table

    confidence = f"{100 * result['bootstrap']['confidence']:.0f} %"
    rows = f"{result['rows_compared']} rows ({result['configurations']} configurations) of {result['data']}"
    print_table(f"errors of {rows}; in brackets {confidence} confidence", *comparison_table(result))
    if len(result["models"]) > 1:
        first = result["models"][0]["name"]
        print_table(f"difference to {first} on the same rows, below 0 is better", *difference_table(result))
    if result["frame_fitted"]:
        typer.echo(FITTED)
    if result["rows_without_position"]:
        typer.echo(f"{result['rows_without_position']} rows hold no position and are not judged.")
    for model in result["models"]:
        if model["rows_not_predicted"]:
            typer.echo(
                f"{model['rows_not_predicted']} rows lie so far outside the domain of {model['name']} that it predicts "
                "nothing; they are left out for all models."
            )
        if model.get("trained_on"):
            typer.echo(
                f"{model['name']} was trained on these rows: its figures say nothing about other poses."
            )
    if result.get("accepted"):
        limits = ", ".join(f"{name} {limit:g}" for name, limit in result["limits"].items())
        typer.echo(f"Accepted: every model stays within {limits}.")
