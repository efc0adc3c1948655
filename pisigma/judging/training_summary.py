"""What a training gave, as figures for tables, cards and `--json`."""

from collections.abc import Mapping
from typing import Any

from pisigma.judging.cross_validation import CrossValidation
from pisigma.judging.pose_statistics import JointStatistics, compare_on
from pisigma.measurement.dataset import Measurements
from pisigma.recipes.recipe import Recipe
from pisigma.workflow.run import JointErrors, TrainingRun

JointReport = dict[str, Any]


def report_joints(recipe: Recipe, run: TrainingRun) -> list[JointReport]:
    """Figures of every corrected joint: on training rows, on held-out rows, and the paper's.

    Returns:
        Per joint ``{"name", "training": {"before", "after"}, "held_out": {...}, "paper": {...}}``; what does
        not exist is left out.
    """
    robot = run.model.robot
    names = [joint.name for joint in robot.joints]
    reports: list[JointReport] = []
    for name in (joint for section in recipe.network for joint in section.joints):
        index = names.index(name)
        report: JointReport = {"name": name}
        for part, errors in (("training", run.training), ("held_out", run.held_out)):
            if errors is not None:
                report[part] = _before_after(errors, index, robot.revolute[index])
        if name in recipe.paper:
            report["paper"] = recipe.paper[name].model_dump()
        reports.append(report)
    return reports


def report_training(
    recipe: Recipe,
    run: TrainingRun,
    cross_validation: CrossValidation | None,
    test: Measurements | None = None,
) -> dict[str, Any]:
    """Everything that is said of a training, apart from where it was written and how long it took.

    Args:
        recipe: what was trained.
        run: what came out.
        cross_validation: errors of held-out rows, for measured data.
        test: rows of the file that were kept aside.

    Raises:
        MeasurementError: the test rows hold no positions.
    """
    report: dict[str, Any] = {
        "rows": {"used": run.model.provenance.rows, "left_out": run.model.provenance.rows_left_out},
        "joints": report_joints(recipe, run),
    }
    if run.model.provenance.rule:
        report["rows"]["rule"] = run.model.provenance.rule
    if cross_validation is not None:
        report["cross_validation"] = cross_validation.in_file_units()
        report["verdict"] = cross_validation.verdict
    if test is not None:
        report["rows"]["kept_aside"] = test.rows
        comparison = compare_on(run.model, test)
        counts = {"rows": test.rows, "rows_not_predicted": comparison.not_predicted}
        report["test"] = {**counts, **comparison.in_file_units()}
    return report


def _before_after(errors: JointErrors, joint: int, revolute: bool) -> Mapping[str, dict[str, float]]:
    return {
        "before": JointStatistics.of(errors.before[:, joint]).in_file_units(revolute),
        "after": JointStatistics.of(errors.after[:, joint]).in_file_units(revolute),
    }
