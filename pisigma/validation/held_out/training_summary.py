"""What a training of networks on joint differences gave: joint errors, and all figures as one typed value."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float64
from torch import Tensor

from pisigma.files.yaml_file import Section
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.network.history import TrainingHistory
from pisigma.network.pairs import TrainingPairs
from pisigma.validation.held_out.pose_statistics import Comparison
from pisigma.validation.held_out.summary import AbstractSummary
from pisigma.validation.held_out.validation_figures import ErrorFigures

LEVEL = 0.05
"""Relative change of an error that is taken for none."""


@dataclass(frozen=True, eq=False)
class JointErrors:
    """Joint errors before and after the correction, of the same rows.

    Attributes:
        T: the poses T_base_tool.
        before: `Δ = q - q_nominal` [rad or m].
        after: `Δ` minus its prediction.
    """

    T: Float64[Tensor, "rows 4 4"]
    before: Float64[Tensor, "rows dof"]
    after: Float64[Tensor, "rows dof"]

    @staticmethod
    def of(model: CalibratedModel, pairs: TrainingPairs) -> "JointErrors":
        """Joint errors of the used rows, before and after the model's correction."""
        T, q, before = pairs.T[pairs.used], pairs.q_nominal[pairs.used], pairs.target[pairs.used]
        return JointErrors(T, before, before - model.correction(T, q))


@dataclass(frozen=True, eq=False)
class TrainingRun:
    """What training the networks of a model gave.

    Attributes:
        model: the model, without figures.
        history: the energies of the training.
        pairs: the training pairs.
        training: joint errors on the training rows.
        held_out: joint errors on simulated rows that the fit did not see; None for measured data.
        measurements: the training rows.
    """

    model: CalibratedModel
    history: TrainingHistory
    pairs: TrainingPairs
    training: JointErrors
    held_out: JointErrors | None
    measurements: Measurements


class JointErrorFigures(Section):
    """Average, standard deviation and maximum of the absolute error of a joint, in degrees or millimetres.

    They are those of Jeong et al. 1998, Tables 1 and 2; the standard deviation is over all rows (divided by n, as the
    paper's figures are).
    """

    average_deg: float | None = None
    deviation_deg: float | None = None
    maximum_deg: float | None = None
    average_mm: float | None = None
    deviation_mm: float | None = None
    maximum_mm: float | None = None

    @staticmethod
    def of(errors: Float64[Tensor, " rows"], revolute: bool) -> "JointErrorFigures":
        """Figures of the errors of a joint [rad or m]."""
        unit, factor = ("deg", math.degrees(1.0)) if revolute else ("mm", 1e3)
        sizes = errors.abs()
        figures = {"average": sizes.mean(), "deviation": sizes.std(correction=0), "maximum": sizes.max()}
        return JointErrorFigures(
            **{f"{name}_{unit}": float(value) * factor for name, value in figures.items()}
        )

    @property
    def unit(self) -> str:
        """Unit of the figures: "deg" for a joint that turns, "mm" for one that slides."""
        return "mm" if self.average_deg is None else "deg"

    @property
    def values(self) -> tuple[float, ...]:
        """Average, standard deviation and maximum."""
        return tuple(value for value in self.model_dump().values() if value is not None)


class BeforeAfter(Section):
    """Errors of a joint before and after the correction."""

    before: JointErrorFigures
    after: JointErrorFigures


class JointFigures(Section):
    """Errors of one corrected joint.

    Attributes:
        name: of the joint.
        training: on the training rows.
        held_out: on simulated rows that the fit did not see.
        paper: published.
    """

    name: str
    training: BeforeAfter | None = None
    held_out: BeforeAfter | None = None
    paper: BeforeAfter | None = None


class RowFigures(Section):
    """Numbers of rows: used for training, left out of it by a rule, and kept apart as the set "test"."""

    used: int
    left_out: int
    rule: str | None = None
    kept_aside: int | None = None


class ComparisonFigures(Section):
    """Pose errors without and with the correction, of the same rows.

    Attributes:
        folds: of a cross-validation.
        rows: number of rows of a test set.
        rows_not_predicted: rows that count in neither, because the model predicts nothing there.
        nominal: without the correction, base and tool as fitted.
        corrected: with it.
    """

    folds: int | None = None
    rows: int | None = None
    rows_not_predicted: int
    nominal: ErrorFigures
    corrected: ErrorFigures

    @staticmethod
    def of(comparison: Comparison, **counts: int) -> "ComparisonFigures":
        """The figures of a comparison, with numbers of folds or rows."""
        return ComparisonFigures(
            **counts,
            rows_not_predicted=comparison.not_predicted,
            nominal=comparison.nominal.figures,
            corrected=comparison.corrected.figures,
        )

    @property
    def models(self) -> dict[str, ErrorFigures]:
        """The errors of both by name."""
        return {"nominal": self.nominal, "corrected": self.corrected}

    @property
    def verdict(self) -> str:
        """Whether the correction helps, in a sentence."""
        nominal, corrected = self.nominal.by_name, self.corrected.by_name
        findings, harm, help_, larger = [], False, False, False
        for name, quantity, unit in (("position", "rms_mm", "mm"), ("orientation", "rms_deg", "deg")):
            if quantity in nominal:
                before, after = nominal[quantity], corrected[quantity]
                change = "lowers" if after < before * (1 - LEVEL) else "does not change"
                change = "raises" if after > before * (1 + LEVEL) else change
                harm, help_ = harm or change == "raises", help_ or change == "lowers"
                rise = _rise(nominal[f"max_{unit}"], corrected[f"max_{unit}"], unit)
                rise = rise and f", {'and' if change == 'raises' else 'but'} {rise}"
                larger = larger or bool(rise)
                findings.append(f"{change} the {name} error ({before:.3f} to {after:.3f} {unit} RMS{rise})")
        advice = "; use it with care" if harm or larger else ""
        advice = advice if help_ else "; do not use it"
        return f"On held-out rows the correction {' and '.join(findings)}{advice}."


class TrainingSummary(AbstractSummary):
    """All figures of a training of networks.

    Attributes:
        rows: how many there were.
        joints: errors of every corrected joint.
        cross_validation: pose errors of rows that were held out in turn, for measured data.
        verdict: whether the correction helps on them, in a sentence.
        test: pose errors of the rows that the file marks as test.
    """

    kinds = ("inverse_calibration",)

    rows: RowFigures
    joints: tuple[JointFigures, ...]
    cross_validation: ComparisonFigures | None = None
    verdict: str | None = None
    test: ComparisonFigures | None = None


def summarise_training(
    run: TrainingRun,
    paper: Mapping[str, BeforeAfter],
    validation: ComparisonFigures | None = None,
    test: ComparisonFigures | None = None,
) -> TrainingSummary:
    """Gather the figures of a training.

    Args:
        run: what came out.
        paper: published figures, by joint.
        validation: errors of rows that were held out in turn.
        test: errors of the rows of the set "test".
    """
    provenance = run.model.provenance
    counts: dict[str, Any] = {"used": provenance.rows, "left_out": provenance.rows_left_out}
    counts |= {"rule": provenance.rule} if provenance.rule else {}
    figures: dict[str, Any] = {"joints": tuple(_joint(run, name, paper) for name in run.history.joints)}
    if validation is not None:
        figures |= {"cross_validation": validation, "verdict": validation.verdict}
    if test is not None:
        counts["kept_aside"] = test.rows
        figures["test"] = test
    return TrainingSummary(rows=RowFigures(**counts), **figures)


def _joint(run: TrainingRun, name: str, paper: Mapping[str, BeforeAfter]) -> JointFigures:
    robot = run.model.robot
    index = [joint.name for joint in robot.joints].index(name)
    figures: dict[str, BeforeAfter] = {}
    for rows, errors in (("training", run.training), ("held_out", run.held_out)):
        if errors is not None:
            before, after = (
                JointErrorFigures.of(values[:, index], robot.revolute[index])
                for values in (errors.before, errors.after)
            )
            figures[rows] = BeforeAfter(before=before, after=after)
    if name in paper:
        figures["paper"] = paper[name]
    return JointFigures(name=name, **figures)


def _rise(before: float, after: float, unit: str) -> str:
    """Say that the largest error rises, by however little; nothing where it does not."""
    texts = f"{before:.3f}", f"{after:.3f}"
    rises = after > before and texts[0] != texts[1]
    return f"the largest rises from {texts[0]} to {texts[1]} {unit}" if rises else ""
