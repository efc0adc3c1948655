"""`pisigma calibrate`: geometric calibration of measured data."""

import inspect
import shlex
import textwrap
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from pisigma.evaluation.geometric_validation import GeometricValidation, TrainTest
    from pisigma.identification.calibrator import GeometricCalibrator
    from pisigma.measurement.dataset import Measurements


def calibrate(
    robot: Annotated[str, typer.Argument(help="Catalogue name or robot file (YAML).")],
    data: Annotated[Path, typer.Argument(help="Measurements (CSV).")],
    out: Annotated[Path, typer.Option(help="Model folder to write.")],
    folds: Annotated[int, typer.Option(min=0, help="Folds of the cross-validation; 0 for none.")] = 5,
    hold_out: Annotated[
        float | None, typer.Option(help="Instead of folds, share of the rows held out once.")
    ] = None,
    split: Annotated[str, typer.Option(help="How rows are parted: joints, time or space.")] = "joints",
    seed: Annotated[int, typer.Option(help="Of the parting.")] = 0,
    free: Annotated[
        str, typer.Option(help="identifiable, joint_offsets, or names such as a_2,theta_3.")
    ] = "identifiable",
    prior_mm: Annotated[
        float, typer.Option(help="Standard deviation of length errors beforehand; 0 for no prior.")
    ] = 1.0,
    prior_mrad: Annotated[float, typer.Option(help="The same of angle errors.")] = 1.0,
    robust: Annotated[bool, typer.Option(help="Let rows that are far off count less.")] = True,
    socket_distance: Annotated[
        str | None,
        typer.Option(
            help="Known distance of two sockets as A,B,MM; */0,*/1,50 means that of every placement."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Identify a robot's geometry from measurements and write it as a model folder with card and figures."""
    started = time.perf_counter()
    from pisigma.cli.output import print_json
    from pisigma.correction.geometric_model import model_of_calibration
    from pisigma.correction.model_folder import save_model
    from pisigma.correction.staging import check_replaceable, staged_folder
    from pisigma.evaluation.calibration_card import write_calibration_card
    from pisigma.evaluation.calibration_report import report_calibration
    from pisigma.evaluation.geometric_validation import judge
    from pisigma.measurement.dataset import Measurements
    from pisigma.robot.description import Robot
    from pisigma.training.geometric_recipe import calibration_section, known_socket_distances
    from pisigma.training.recipe_data import part_sets

    check_replaceable(out)
    nominal = Robot.load(robot)
    measurements, test = part_sets(Measurements.read_csv(data, nominal))
    calibrator = replace(
        calibration_section(free, prior_mm, prior_mrad, robust).calibrator(nominal),
        socket_distances=known_socket_distances(socket_distance, measurements.socket or ()),
    )
    parts = _parts(measurements, folds, hold_out, seed, split)
    result = calibrator.fit(measurements)
    validation = _validate(calibrator, measurements, parts)
    kept_aside = None if test is None else judge(calibrator, result, measurements, test)
    report = {"rows": measurements.rows, **report_calibration(result, validation, kept_aside)}
    model = replace(model_of_calibration(out.resolve().name, nominal, result, measurements), metrics=report)
    options = {"folds": folds, "hold-out": hold_out, "split": split, "seed": seed, "free": free}
    options |= {"prior-mm": prior_mm, "prior-mrad": prior_mrad, "robust": robust}
    options |= {"socket-distance": socket_distance}
    texts = {
        "description": f"Geometric calibration of robot {nominal.name} ({nominal.maker}): DH and Hayati "
        "parameters, base and tool by least squares.",
        "command": _command_line(robot, data, out, options),
        "not_validated": "Judged on rows of the same measurement only, not on other days, payloads or "
        "temperatures.",
    }
    with staged_folder(out) as scratch:
        save_model(model, scratch)
        write_calibration_card(model, result, validation or kept_aside, report, texts, scratch)
    finished = {"model": str(out), "seconds": round(time.perf_counter() - started, 3), **report}
    if as_json:
        print_json(finished)
    else:
        print_calibration(finished)


def print_calibration(result: dict[str, Any]) -> None:
    """Print what a calibration gave, for people."""
    from pisigma.cli.output import WIDTH_WITHOUT_TERMINAL, print_table
    from pisigma.evaluation.calibration_card import PARAMETER_COLUMNS, not_identified_lines, parameter_table
    from pisigma.evaluation.tables import pose_rows

    print_table("parameters", PARAMETER_COLUMNS, parameter_table(result))
    typer.echo("What the data do not tell:")
    for line in not_identified_lines(result):
        typer.echo(textwrap.fill(f"- {line}", WIDTH_WITHOUT_TERMINAL, subsequent_indent="  "))
    for key, title in (
        ("cross_validation", "pose errors of {rows} held-out rows ({folds} folds)"),
        ("test", "pose errors of the {rows} rows of the set 'test', which were kept aside"),
    ):
        if key in result:
            models = {name: result[key][name] for name in ("nominal", "geometric")}
            print_table(title.format(**result[key]), *pose_rows(models))
    outliers = result["outliers"]
    worst = f"; the worst is {outliers[0]['place']}" if outliers else ""
    typer.echo(f"Rank {result['rank']}, {result['iterations']} iterations, {len(outliers)} outliers{worst}.")
    typer.echo(f"Model written to {result['model']} in {result['seconds']:.1f} s; read its README.md.")


def _command_line(robot: str, data: Path, out: Path, options: dict[str, Any]) -> str:
    """The command that gives this model again, with the options that are not the default."""
    defaults = inspect.signature(calibrate).parameters
    words = ["pisigma", "calibrate", Path(robot).name, data.name, "--out", out.name]
    for name, value in options.items():
        if value == defaults[name.replace("-", "_")].default:
            continue
        words += (
            [f"--{name}" if value else f"--no-{name}"]
            if isinstance(value, bool)
            else [f"--{name}", str(value)]
        )
    return shlex.join(words)


def _parts(
    measurements: "Measurements", folds: int, hold_out: float | None, seed: int, split: str
) -> "Sequence[TrainTest]":
    from pisigma.errors import MeasurementError, nearest_choice
    from pisigma.measurement.splits import holdout, k_folds

    if split not in ("joints", "time", "space"):
        raise MeasurementError(
            f"--split '{split}' is unknown; {nearest_choice(split, ('joints', 'time', 'space'))}"
        )
    if hold_out is not None:
        return [holdout(measurements, hold_out, seed, split)]  # type: ignore[arg-type]
    return k_folds(measurements, folds, seed, split) if folds else []  # type: ignore[arg-type]


def _validate(
    calibrator: "GeometricCalibrator", measurements: "Measurements", parts: "Sequence[TrainTest]"
) -> "GeometricValidation | None":
    from rich.console import Console

    from pisigma.evaluation.geometric_validation import validate_geometric

    if not parts:
        return None
    with Console(stderr=True).status("cross-validation") as status:
        return validate_geometric(
            calibrator,
            measurements,
            parts,
            lambda done, folds: status.update(f"cross-validation: fold {done + 1} of {folds}"),
        )
