"""Results of training networks on joint errors: joint errors before and after the correction, and other figures."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from jaxtyping import Float64
from torch import Tensor

from pisigma.files.yaml_file import Section
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.network.energy import TrainingHistory
from pisigma.network.pairs import TrainingPairs
from pisigma.validation.held_out.pose_statistics import Comparison
from pisigma.validation.held_out.summary import AbstractSummary
from pisigma.validation.held_out.validation_figures import ErrorFigures

_LEVEL = 0.05
"""Relative change of an error below which it is treated as unchanged."""


Effect = Literal["lowers", "does not change", "raises"]
"""Effect of a correction on an error."""
Recommendation = Literal["use it", "use it with care", "do not use it"]
_QUANTITIES = {"position": "mm", "orientation": "deg"}
"""Unit of every compared quantity."""


@dataclass(frozen=True, eq=False)
class JointErrors:
    """Joint errors of the same rows before and after the correction.

    Attributes:
        T: the poses T_base_tool.
        before: `Δ = q - q_nominal` [rad or m].
        after: `Δ` minus its prediction.
    """

    T: Float64[Tensor, "rows 4 4"]
    before: Float64[Tensor, "rows dof"]
    after: Float64[Tensor, "rows dof"]

    @staticmethod
    def from_model(model: CalibratedModel, pairs: TrainingPairs) -> "JointErrors":
        """Return the joint errors of the rows used for training, before and after the model's correction."""
        T, q, before = (
            pairs.T[pairs.used_rows],
            pairs.q_nominal[pairs.used_rows],
            pairs.target[pairs.used_rows],
        )
        return JointErrors(T, before, before - model.correction(T, q))


@dataclass(frozen=True, eq=False)
class TrainingRun:
    """Result of training the networks of a model.

    Attributes:
        model: the model, without figures.
        history: the energies of the training.
        pairs: the training pairs.
        training: joint errors on the training rows.
        held_out: joint errors on held-out simulated rows; None for measured data.
        measurements: the training rows.
    """

    model: CalibratedModel
    history: TrainingHistory
    pairs: TrainingPairs
    training: JointErrors
    held_out: JointErrors | None
    measurements: Measurements


class AbsoluteJointErrorFigures(Section):
    """Average, standard deviation and maximum of the absolute error of a joint, in degrees or millimetres.

    The figures are defined as in Jeong et al. 1998, Tables 1 and 2; the standard deviation is over all rows (divided
    by n, as in the paper).

    Attributes:
        average_deg: average of a revolute joint [deg].
        deviation_deg: standard deviation of a revolute joint [deg].
        maximum_deg: maximum of a revolute joint [deg].
        average_mm: average of a prismatic joint [mm].
        deviation_mm: standard deviation of a prismatic joint [mm].
        maximum_mm: maximum of a prismatic joint [mm].
    """

    average_deg: float | None = None
    deviation_deg: float | None = None
    maximum_deg: float | None = None
    average_mm: float | None = None
    deviation_mm: float | None = None
    maximum_mm: float | None = None

    @staticmethod
    def from_errors(errors: Float64[Tensor, " rows"], revolute: bool) -> "AbsoluteJointErrorFigures":
        """Compute the figures of the errors of a joint [rad or m]."""
        unit, factor = ("deg", math.degrees(1.0)) if revolute else ("mm", 1e3)
        sizes = errors.abs()
        figures = {"average": sizes.mean(), "deviation": sizes.std(correction=0), "maximum": sizes.max()}
        return AbsoluteJointErrorFigures(
            **{f"{name}_{unit}": float(value) * factor for name, value in figures.items()}
        )

    @property
    def unit(self) -> str:
        """Unit of the figures: "deg" for a revolute joint, "mm" for a prismatic one."""
        return "mm" if self.average_deg is None else "deg"

    @property
    def values(self) -> tuple[float, ...]:
        """Average, standard deviation and maximum."""
        return tuple(value for value in self.model_dump().values() if value is not None)


class BeforeAfter(Section):
    """Errors of a joint before and after the correction.

    Attributes:
        before: errors before the correction.
        after: errors after the correction.
    """

    before: AbsoluteJointErrorFigures
    after: AbsoluteJointErrorFigures


class JointFigures(Section):
    """Errors of one corrected joint.

    Attributes:
        name: name of the joint.
        training: errors on the training rows.
        held_out: errors on held-out simulated rows.
        paper: published errors.
    """

    name: str
    training: BeforeAfter | None = None
    held_out: BeforeAfter | None = None
    paper: BeforeAfter | None = None


class RowFigures(Section):
    """Numbers of rows used for training, left out by a rule, and held out as the set "test"."""

    used: int
    left_out: int
    rule: str | None = None
    kept_aside: int | None = None


class ComparisonFigures(Section):
    """Pose errors of the same rows without and with the correction.

    Attributes:
        folds: number of folds of a cross-validation.
        rows: number of rows of a test set.
        rows_not_predicted: number of rows that are not compared because the model has no prediction for them.
        nominal: errors without the correction, with base and tool as fitted.
        corrected: errors with the correction.
    """

    folds: int | None = None
    rows: int | None = None
    rows_not_predicted: int
    nominal: ErrorFigures
    corrected: ErrorFigures

    @staticmethod
    def from_comparison(comparison: Comparison, **counts: int) -> "ComparisonFigures":
        """Compute the figures of a comparison, with numbers of folds or rows."""
        return ComparisonFigures(
            **counts,
            rows_not_predicted=comparison.rows_not_predicted,
            nominal=comparison.nominal.figures,
            corrected=comparison.corrected.figures,
        )

    @property
    def models(self) -> dict[str, ErrorFigures]:
        """Errors of the nominal and the corrected model, by name."""
        return {"nominal": self.nominal, "corrected": self.corrected}

    @property
    def effects(self) -> dict[str, Effect]:
        """Effect of the correction on the RMS errors of "position" and, if measured, of "orientation"."""
        nominal, corrected = self.nominal.figures_by_name, self.corrected.figures_by_name
        return {
            name: _effect(nominal[f"rms_{unit}"], corrected[f"rms_{unit}"])
            for name, unit in _QUANTITIES.items()
            if f"rms_{unit}" in nominal
        }

    @property
    def increased_maxima(self) -> tuple[str, ...]:
        """Quantities whose largest error is increased by the correction by more than rounding."""
        nominal, corrected = self.nominal.figures_by_name, self.corrected.figures_by_name
        return tuple(
            name
            for name in self.effects
            for unit in [_QUANTITIES[name]]
            if _rise(nominal[f"max_{unit}"], corrected[f"max_{unit}"], unit)
        )

    @property
    def recommendation(self) -> Recommendation:
        """Recommendation on the use of the correction."""
        effects = self.effects.values()
        if "lowers" not in effects:
            return "do not use it"
        return "use it with care" if "raises" in effects or self.increased_maxima else "use it"

    @property
    def verdict(self) -> str:
        """Sentence on the effect of the correction on held-out rows and on whether to use it."""
        nominal, corrected = self.nominal.figures_by_name, self.corrected.figures_by_name
        findings = []
        for name, effect in self.effects.items():
            unit = _QUANTITIES[name]
            before, after = nominal[f"rms_{unit}"], corrected[f"rms_{unit}"]
            rise = _rise(nominal[f"max_{unit}"], corrected[f"max_{unit}"], unit)
            rise = rise and f", {'and' if effect == 'raises' else 'but'} {rise}"
            findings.append(f"{effect} the {name} error ({before:.3f} to {after:.3f} {unit} RMS{rise})")
        advice = "" if self.recommendation == "use it" else f"; {self.recommendation}"
        return f"On held-out rows the correction {' and '.join(findings)}{advice}."


class TrainingSummary(AbstractSummary):
    """All figures of a training run.

    Attributes:
        rows: numbers of rows.
        joints: errors of every corrected joint.
        cross_validation: pose errors of held-out rows, for measured data.
        verdict: effect of the correction on held-out rows, as a sentence.
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
    """Return the figures of a training.

    Args:
        run: result of the training.
        paper: published figures, by joint.
        validation: errors of the cross-validation.
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
                AbsoluteJointErrorFigures.from_errors(values[:, index], robot.revolute[index])
                for values in (errors.before, errors.after)
            )
            figures[rows] = BeforeAfter(before=before, after=after)
    if name in paper:
        figures["paper"] = paper[name]
    return JointFigures(name=name, **figures)


def _effect(before: float, after: float) -> Effect:
    if after > before * (1 + _LEVEL):
        return "raises"
    return "lowers" if after < before * (1 - _LEVEL) else "does not change"


def _rise(before: float, after: float, unit: str) -> str:
    """Return a clause stating that the largest error increases; "" if it does not within the digits shown."""
    texts = f"{before:.3f}", f"{after:.3f}"
    rises = after > before and texts[0] != texts[1]
    return f"the largest rises from {texts[0]} to {texts[1]} {unit}" if rises else ""
