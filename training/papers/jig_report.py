"""Results of the recipe of jigs: comparison with the tables of the paper, averages over seeds, planned touches."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from jig_accuracy import DEFINITIONS, Accuracy, Bench, accuracy_figures, deviation, measure_accuracy, rms
from jig_recipe import JigCalibration, JigRecipe, calibrate_on, nominal_calibration
from pisigma.files.errors import RecipeError
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.row import FRAME_COLUMNS
from pisigma.simulation.touch_candidates import TouchCandidates
from straight_lines import TrackedLine, i_move, move_l
from touch_planning import MeasurementPlan, PlanningProblem, plan_measurements

Progress = Callable[[str], None]

BOTH, DEFAULT, PLANNED, RANDOM = "both", "default", "planned", "random"
FIGURES = ("rms", "deviation", "mean", "workspace_median", "workspace_rms")


@dataclass(frozen=True, eq=False)
class JigRun:
    """Data of the report, the card and the pictures.

    Attributes:
        bench: The true robot and the poses at which it is evaluated.
        candidates: Touches of the first seed.
        measurements: Their measurements.
        calibrations: Calibrations with the first seed, by set-up: "nominal", every jig alone, "both", "default".
        accuracies: Their accuracies.
        lines: Move-L and I-Move, by set-up and line.
        problem: Planning problem of all candidates.
        planned_from: The candidates of the plan.
        plan: The chosen touches.
        seeds: One value per seed [m], by set-up and figure.
    """

    bench: Bench
    candidates: TouchCandidates
    measurements: Measurements
    calibrations: dict[str, JigCalibration]
    accuracies: dict[str, Accuracy]
    lines: dict[str, dict[str, tuple[TrackedLine, TrackedLine]]]
    problem: PlanningProblem
    planned_from: TouchCandidates
    plan: MeasurementPlan
    seeds: dict[str, dict[str, Float64[np.ndarray, " seeds"]]]


def run_jigs(recipe: JigRecipe, progress: Progress = lambda text: None) -> JigRun:
    """Touch, calibrate and plan, and repeat this for every seed.

    Args:
        recipe: Recipe to simulate.
        progress: Called with the name of each step.

    Raises:
        IdentificationError: The touches do not determine the parameters.
        UnreachablePoseError: A touch, a test point or a line cannot be reached.
        RecipeError: The recipe is inconsistent.
    """
    _check_jigs(recipe)
    bench = Bench.from_recipe(recipe)
    progress("planning touches")
    planned_from = recipe.planning.candidates.find(Robot.load(recipe.robot), recipe.placements)
    problem = recipe.planning_problem(planned_from)
    plan = plan_measurements(problem, recipe.planning.touches)
    figures: dict[str, dict[str, list[float]]] = {}
    for seed in range(recipe.seeds):
        progress(f"seed {seed + 1} of {recipe.seeds}")
        candidates = recipe.draw_touches(seed)
        measurements = recipe.measure(candidates, seed)
        calibrations = _calibrations(recipe, measurements)
        calibrations |= _planned_and_random(recipe, planned_from, plan, seed)
        accuracies = {name: measure_accuracy(bench, value) for name, value in calibrations.items()}
        for name, accuracy in accuracies.items():
            _append(figures.setdefault(name, {}), accuracy)
        if seed == 0:
            shown = (candidates, measurements, calibrations, accuracies)
    progress("straight lines")
    candidates, measurements, calibrations, accuracies = shown
    return JigRun(
        bench=bench,
        candidates=candidates,
        measurements=measurements,
        calibrations=calibrations,
        accuracies=accuracies,
        lines={name: _drive(bench, calibrations[name]) for name in ("nominal", BOTH, DEFAULT)},
        problem=problem,
        planned_from=planned_from,
        plan=plan,
        seeds={
            setup: {name: np.array(values) for name, values in by_name.items()}
            for setup, by_name in figures.items()
        },
    )


def report_jigs(run: JigRun) -> dict[str, Any]:
    """Return all figures of a run, in millimetres and degrees."""
    recipe = run.bench.recipe
    return {
        "definitions": list(DEFINITIONS),
        "touches_per_jig": recipe.touches.count,
        "noise": recipe.noise.model_dump(),
        "parameters_estimated": {
            name: len(calibration.result.free_parameters)
            for name, calibration in run.calibrations.items()
            if calibration.result is not None
        },
        "parameters": parameter_table(run),
        "accuracy": {name: accuracy_figures(value) for name, value in run.accuracies.items()},
        "lines": {
            setup: {
                name: {"move_l": _line(straight), "i_move": _line(moved)}
                for name, (straight, moved) in lines.items()
            }
            for setup, lines in run.lines.items()
        },
        "seeds": seed_figures(run.seeds, recipe.frames),
        "planning": {
            "candidates": run.planned_from.count,
            "touches": len(run.plan.chosen),
            "predicted_rms_mm": run.plan.predicted_error * 1e3,
            "exchanges": len(run.plan.path) - 1,
            "per_jig": _counts(run, run.plan.chosen),
        },
        "weak_directions": [
            sentence
            for calibration in (run.calibrations[DEFAULT],)
            if calibration.result is not None
            for sentence in calibration.result.weak_directions
        ],
        "paper": recipe.paper,
    }


def parameter_table(run: JigRun) -> list[dict[str, Any]]:
    """Return Table 2: nominal, true and estimated values of the parameters, and the paper's estimates."""
    recipe = run.bench.recipe
    published = recipe.paper.get("parameters", {})
    truth = {p.name: (p.true_base or p.base).to_si() for p in recipe.placements}
    values = {name: _values(c.arm, c.bases) for name, c in run.calibrations.items()}
    values["true"] = _values(run.bench.true_robot.true_geometry, truth)
    tool = tuple(f"tool_{column}" for column in ("x", "y", "z"))
    names = [*recipe.paper_parameters, *tool]
    names += [f"base_{frame}_{column}" for frame in recipe.frames for column in FRAME_COLUMNS]
    shown = ("nominal", "true", *recipe.frames, BOTH, DEFAULT)
    return [
        {
            "name": name,
            "unit": "mm" if _is_length(name) else "deg",
            **{setup: values[setup].get(name) for setup in shown},
            "paper": {setup: published.get(setup, {}).get(name) for setup in (*recipe.frames, BOTH)},
        }
        for name in names
    ]


def seed_figures(
    seeds: dict[str, dict[str, Float64[np.ndarray, " seeds"]]], frames: tuple[str, ...]
) -> dict[str, Any]:
    """Return averages over the seeds, their standard deviations (divided by n), and their ratios [mm]."""
    averages = {
        setup: {f"{name}_mm": float(values.mean()) * 1e3 for name, values in figures.items()}
        for setup, figures in seeds.items()
    }
    spreads = {
        setup: {f"{name}_mm": float(values.std()) * 1e3 for name, values in figures.items()}
        for setup, figures in seeds.items()
    }
    single = {name: np.mean([seeds[frame][name] for frame in frames], axis=0) for name in FIGURES}
    return {
        "count": len(seeds[BOTH]["rms"]),
        "averages": averages,
        "spreads": spreads,
        "ratios": {
            "both_over_single": _ratios(seeds[BOTH], single),
            "default_over_paper": _ratios(seeds[DEFAULT], seeds[BOTH]),
            "planned_over_random": _ratios(seeds[PLANNED], seeds[RANDOM]),
        },
        "share_of_seeds_won_by_both": float((seeds[BOTH]["rms"] < single["rms"]).mean()),
    }


def _calibrations(recipe: JigRecipe, measurements: Measurements) -> dict[str, JigCalibration]:
    """Return the nominal robot and the calibrations with each jig, with all jigs, and of everything identifiable."""
    found = {"nominal": nominal_calibration(recipe)}
    for frame in recipe.frames:
        found[frame] = calibrate_on(recipe, measurements, (frame,))
    found[BOTH] = calibrate_on(recipe, measurements, recipe.frames)
    found[DEFAULT] = calibrate_on(recipe, measurements, recipe.frames, "default")
    return found


def _planned_and_random(
    recipe: JigRecipe, candidates: TouchCandidates, plan: MeasurementPlan, seed: int
) -> dict[str, JigCalibration]:
    """Return calibrations with the planned touches, and with the same number drawn at random from the candidates."""
    generator = torch.Generator().manual_seed(recipe.planning.candidates.seed + seed)
    drawn = torch.randperm(candidates.count, generator=generator)[: len(plan.chosen)].sort().values
    found = {}
    for name, chosen in ((PLANNED, plan.chosen), (RANDOM, drawn)):
        touched = recipe.measure(candidates.select(chosen), seed)
        found[name] = calibrate_on(recipe, touched, recipe.frames)
    return found


def _append(figures: dict[str, list[float]], accuracy: Accuracy) -> None:
    errors, workspace = accuracy.points, accuracy.workspace
    values = (
        rms(errors),
        deviation(errors),
        float(errors.norm(dim=-1).mean()),
        float(workspace.median()),
        float(workspace.square().mean().sqrt()),
    )
    for name, value in zip(FIGURES, values, strict=True):
        figures.setdefault(name, []).append(value)


def _drive(bench: Bench, calibration: JigCalibration) -> dict[str, tuple[TrackedLine, TrackedLine]]:
    """Return every line by Move-L and by I-Move."""
    controller, found = bench.controller(calibration.arm), {}
    for line in bench.recipe.lines:
        T = line.T_ends
        found[line.name] = (
            move_l(bench.true_robot, controller, T),
            i_move(bench.true_robot, controller, T[0], T[1, :3, 3] - T[0, :3, 3]),
        )
    return found


def _line(line: TrackedLine) -> dict[str, Any]:
    return {
        "length_error_mm": line.length_error * 1e3,
        "deviation_mm": dict(zip("xyz", (line.largest * 1e3).tolist(), strict=True)),
        "largest_across_mm": line.largest_across * 1e3,
    }


def _counts(run: JigRun, chosen: torch.Tensor) -> dict[str, dict[str, int]]:
    """Return the number of touches along every axis on every jig."""
    touched = run.planned_from.select(chosen)
    pairs = list(zip(touched.frame, touched.touch_axis, strict=True))
    return {frame: {axis: pairs.count((frame, axis)) for axis in "xyz"} for frame in run.bench.recipe.frames}


def _ratios(
    of: dict[str, Float64[np.ndarray, " seeds"]], to: dict[str, Float64[np.ndarray, " seeds"]]
) -> dict[str, float]:
    """Return the ratio of two averages."""
    return {name: float(of[name].mean() / to[name].mean()) for name in FIGURES}


def _values(arm: Robot, bases: dict[str, Float64[np.ndarray, " 6"]]) -> dict[str, float]:
    """Return parameters by name [mm, deg]."""
    found = {}
    for row, parameters in enumerate(arm.dh.tolist(), start=1):
        for column, value in zip(("theta", "d", "a", "alpha", "beta"), parameters, strict=True):
            found[f"{column}_{row}"] = value
    for stem, frame in (("tool", arm.tool), *((f"base_{name}", base) for name, base in bases.items())):
        for column, value in zip(FRAME_COLUMNS, frame.tolist(), strict=True):
            found[f"{stem}_{column}"] = value
    return {
        name: value * 1e3 if _is_length(name) else math.degrees(math.remainder(value, math.tau))
        for name, value in found.items()
    }


def _is_length(name: str) -> bool:
    return name.startswith(("d_", "a_")) or name.endswith(("_x", "_y", "_z"))


def _check_jigs(recipe: JigRecipe) -> None:
    if len(recipe.placements) < 2:
        raise RecipeError(expected="two or more placements, to compare them", value=1, option="placements")
