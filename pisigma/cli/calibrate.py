"""`pisigma calibrate`: geometric or hybrid calibration of measured data."""

import inspect
import shlex
import textwrap
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

if TYPE_CHECKING:
    from pisigma.identification.calibrator import GeometricCalibrator
    from pisigma.judging.trained_calibrations import Calibrator, Result
    from pisigma.measurement.dataset import Measurements
    from pisigma.measurement.splits import TrainTest
    from pisigma.model.calibrated_model import CalibratedModel
    from pisigma.robot.description import Robot

FOLDS = 5
"""Of a cross-validation that is not by placement."""
MODELS = ("geometric", "hybrid")
"""What may be fitted."""


def calibrate(
    robot: Annotated[str, typer.Argument(help="Catalogue name or robot file (YAML or URDF).")],
    data: Annotated[Path, typer.Argument(help="Measurements (CSV).")],
    out: Annotated[Path, typer.Option(help="Model folder to write.")],
    model: Annotated[
        str,
        typer.Option(
            help="hybrid: geometry and, where the data are for it, a joint correction; or geometric."
        ),
    ] = "hybrid",
    folds: Annotated[
        int | None,
        typer.Option(
            min=0, help="Folds of the cross-validation, 0 for none. [default: 5, or one per placement]"
        ),
    ] = None,
    hold_out: Annotated[
        float | None, typer.Option(help="Instead of folds, share of the rows held out once.")
    ] = None,
    split: Annotated[
        str,
        typer.Option(help="How rows are parted: joints (at random), interleaved, time, space or placement."),
    ] = "joints",
    repeats: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Times that the rows are dealt to the folds. [default: 200 / different joint values, 1 to 10]",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the parting, and of drawing training rows.")] = 0,
    train_rows: Annotated[
        int | None,
        typer.Option(
            help="Calibrate, in the cross-validation too, with so many rows drawn at random. [default: all]"
        ),
    ] = None,
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
    base: Annotated[
        str | None, typer.Option(help="Of a URDF file: link that is the base. [default: its root]")
    ] = None,
    tip: Annotated[
        str | None, typer.Option(help="Of a URDF file: link that is the tool. [default: its only leaf]")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Calibrate a robot from measurements and write it as a model folder with card and figures.

    Geometry, base and tool, and with them a correction of the joints where it predicts left-out rows better.
    """
    started = time.perf_counter()
    from pisigma.cli.output import print_json
    from pisigma.cli.progress import progress_of
    from pisigma.judging.calibration_validation import judge, validate_repeatedly
    from pisigma.judging.held_out_rows import HELD_OUT_CSV, held_out_csv, held_out_section
    from pisigma.judging.trained_calibrations import fit
    from pisigma.measurement.dataset import Measurements
    from pisigma.model.folder.model_folder import save_model
    from pisigma.model.folder.staging import check_replaceable, staged_folder
    from pisigma.recipes.geometric_recipe import calibration_section, known_socket_distances
    from pisigma.recipes.recipe_data import split_sets
    from pisigma.reporting.calibration_card import write_calibration_card
    from pisigma.reporting.calibration_report import report_calibration
    from pisigma.robot.description import Robot

    check_replaceable(out)
    nominal = Robot.load(robot, base, tip)
    measurements, test = split_sets(Measurements.read_csv(data, nominal))
    geometric = replace(
        calibration_section(free, prior_mm, prior_mrad, robust).calibrator(nominal),
        socket_distances=known_socket_distances(socket_distance, measurements.socket or ()),
    )
    calibrator = _calibrator(model, geometric)
    parts = _parts(measurements, folds, hold_out, seed, split, repeats)
    rows, parts = _drawn(measurements, parts, train_rows, seed)
    with progress_of("calibration") as tell:
        result = fit(calibrator, rows, tell)
    with progress_of("cross-validation") as tell:
        validation = validate_repeatedly(calibrator, measurements, parts, tell) if parts else None
    kept_aside = None if test is None else judge(calibrator, result, rows, test)
    report = {"rows": rows.rows, **report_calibration(result, validation, kept_aside)}
    held_out = None if validation is None else held_out_csv(validation, measurements, nominal)
    if held_out is not None:
        report |= held_out_section(held_out, measurements)
    found = replace(_model(out.resolve().name, nominal, result, rows), metrics=report)
    options = {"model": model, "folds": folds, "hold-out": hold_out, "split": split, "seed": seed}
    options |= {
        "repeats": repeats,
        "train-rows": train_rows,
        "free": free,
        "prior-mm": prior_mm,
        "prior-mrad": prior_mrad,
    }
    options |= {"robust": robust, "socket-distance": socket_distance, "base": base, "tip": tip}
    texts = {
        "description": _description(model, nominal),
        "command": _command_line(robot, data, out, options),
        "not_validated": "Judged on rows of the same measurement only, not on other days, payloads or "
        "temperatures.",
    }
    with staged_folder(out) as scratch:
        save_model(found, scratch)
        write_calibration_card(found, result, rows, validation or kept_aside, report, texts, scratch)
        if held_out is not None:
            (scratch / HELD_OUT_CSV).write_text(held_out, encoding="utf-8", newline="\n")
    finished = {"model": str(out), "seconds": round(time.perf_counter() - started, 3), **report}
    if as_json:
        print_json(finished)
    else:
        print_calibration(finished)


def print_calibration(result: dict[str, Any]) -> None:
    """Print what a calibration gave, for people."""
    from pisigma.cli.output import WIDTH_WITHOUT_TERMINAL, print_table
    from pisigma.reporting.calibration_card import PARAMETER_COLUMNS, not_identified_lines, parameter_table
    from pisigma.reporting.held_out_sentences import folds_text, held_out_lines
    from pisigma.reporting.hybrid_card import compared, curve_rows
    from pisigma.reporting.hybrid_report import TRIAL_COLUMNS, coverage_line, learned_lines, trial_rows
    from pisigma.reporting.tables import pose_rows

    print_table("parameters", PARAMETER_COLUMNS, parameter_table(result))
    typer.echo("What the data do not tell:")
    for line in not_identified_lines(result):
        typer.echo(textwrap.fill(f"- {line}", WIDTH_WITHOUT_TERMINAL, subsequent_indent="  "))
    if "hybrid" in result:
        print_table("what was tried beyond the geometry", TRIAL_COLUMNS, trial_rows(result["hybrid"]))
        for line in learned_lines(result["hybrid"]):
            typer.echo(textwrap.fill(line, WIDTH_WITHOUT_TERMINAL))
    for key, title in (
        ("held_out", "pose errors of {rows} other simulated rows"),
        ("cross_validation", "pose errors of {rows} held-out rows ({how})"),
        ("test", "pose errors of the {rows} rows of the set 'test', which were kept aside"),
    ):
        if key in result:
            models = compared(result[key])
            if models:
                how = folds_text(result[key])
                print_table(title.format(**result[key], how=how), *pose_rows(models))
            lines = held_out_lines(result[key])
            lines += [coverage_line(result[key])] if "coverage" in result[key] else []
            for line in lines:
                typer.echo(textwrap.fill(line, WIDTH_WITHOUT_TERMINAL))
    if "learning_curve" in result:
        print_table(
            "errors of held-out rows by number of training rows", *curve_rows(result["learning_curve"])
        )
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
    measurements: "Measurements",
    folds: int | None,
    hold_out: float | None,
    seed: int,
    split: str,
    times: int | None,
) -> "Sequence[Sequence[TrainTest]]":
    """Per repeat its parts; one part for rows that are held out once."""
    from pisigma.errors import MeasurementError, nearest_choice
    from pisigma.measurement.splits import SplitBy, holdout, repeats

    choices: tuple[str, ...] = get_args(SplitBy)
    if split not in choices:
        raise MeasurementError(f"--split '{split}' is unknown; {nearest_choice(split, choices)}")
    if times is not None and times > 1 and (hold_out is not None or folds == 0):
        raise MeasurementError(
            f"--repeats {times}: rows are dealt to folds; leave out --hold-out and --folds 0."
        )
    if hold_out is not None and folds is not None:
        raise MeasurementError(
            f"--folds {folds} and --hold-out {hold_out:g} exclude each other; leave one out."
        )
    by: Any = split
    if hold_out is not None:
        return [[holdout(measurements, hold_out, seed, by)]]
    if folds is None and split != "placement":
        folds = FOLDS
    return [] if folds == 0 else repeats(measurements, folds, seed, by, times)


def _drawn(
    measurements: "Measurements", parts: "Sequence[Sequence[TrainTest]]", rows: int | None, seed: int
) -> "tuple[Measurements, Sequence[Sequence[TrainTest]]]":
    """The rows to calibrate with, all or some of them, and parts with as many training rows."""
    from pisigma.measurement.splits import draw_rows, with_fewer

    if rows is None:
        return measurements, parts
    parts = [with_fewer(measurements, dealt, rows, seed) for dealt in parts]
    return measurements.select(draw_rows(measurements, rows, seed)), parts


def _calibrator(model: str, geometric: "GeometricCalibrator") -> "Calibrator":
    from pisigma.errors import IdentificationError, nearest_choice
    from pisigma.hybrid.calibrator import HybridCalibrator

    if model not in MODELS:
        raise IdentificationError(f"--model '{model}' is unknown; {nearest_choice(model, MODELS)}")
    return HybridCalibrator(geometric) if model == "hybrid" else geometric


def _model(name: str, nominal: "Robot", result: "Result", rows: "Measurements") -> "CalibratedModel":
    from pisigma.hybrid.result import HybridResult
    from pisigma.model.geometric_model import model_of_calibration, model_of_hybrid

    if isinstance(result, HybridResult):
        return model_of_hybrid(name, nominal, result, rows)
    return model_of_calibration(name, nominal, result, rows)


def _description(model: str, nominal: "Robot") -> str:
    if model == "geometric":
        return (
            f"Geometric calibration of robot {nominal.name} ({nominal.maker}): DH and Hayati parameters, base and tool "
            "by least squares."
        )
    return (
        f"Hybrid calibration of robot {nominal.name} ({nominal.maker}): DH and Hayati parameters, base and tool, and "
        "with them, where the data are for it, a Pi-Sigma network that corrects the joint values."
    )
