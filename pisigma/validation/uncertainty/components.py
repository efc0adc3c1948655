"""Components of the uncertainty of a corrected robot, from a model, its rows, and values stated for the cell.

Functions return a `Component`, or a sentence that names the missing statement.
"""

import math
from collections.abc import Mapping, Sequence

import torch

from pisigma.measurement.dataset import Measurements
from pisigma.model.accuracy import sigma_of_rows
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.stated_conditions import learned_range
from pisigma.validation.held_out.calibration_summary import CalibrationSummary, NoiseFigures
from pisigma.validation.uncertainty.budget import Component, UncertaintyBudget
from pisigma.validation.uncertainty.instrument import Instrument

SCATTER = "scatter that the model does not explain"
"""Name of the component that makes a budget comparable with measured errors."""
_POSITION = "position"
"""Sensor whose residuals are coordinates of positions."""


def uncertainty_budget(
    model: CalibratedModel,
    poses: Measurements | None,
    rows_name: str,
    instrument: Instrument,
    temperatures: Mapping[str, float | None],
    session_names: Sequence[str],
    expansion_per_k: float | None,
    repeatability_mm: float | None = None,
) -> UncertaintyBudget:
    """Return the budget of one coordinate of the tool's position, with the correction active.

    The scatter of the calibration contains the repeatability of the robot, the random errors of the instrument, and
    errors that the model cannot express; the certificate of the instrument also covers its random errors. The budget
    therefore tends to be too large rather than too small.

    Args:
        model: the model.
        poses: rows with the joint values for which the uncertainty of the model is computed; None if there are none.
        rows_name: name of these rows.
        instrument: the instrument of the cell.
        temperatures: mean temperature of every session [deg C], by name; None if the rows do not state it.
        session_names: names of the sessions to which the model was fitted.
        expansion_per_k: coefficient of linear expansion of the arm [1/K]; None if it is not stated.
        repeatability_mm: pose repeatability RP stated by the manufacturer [mm], which is used if the scatter is
            unknown; None if it is not stated.
    """
    scatter = scatter_component(model)
    found = (
        parameter_component(model, poses, rows_name),
        scatter,
        *([repeatability_component(repeatability_mm)] if isinstance(scatter, str) else []),
        instrument_component(instrument),
        thermal_component(model, temperatures, session_names, expansion_per_k),
    )
    components = tuple(one for one in found if isinstance(one, Component))
    return UncertaintyBudget(components, tuple(one for one in found if isinstance(one, str)))


def parameter_component(
    model: CalibratedModel, poses: Measurements | None, rows_name: str
) -> Component | str:
    """Evaluate the uncertainty of the parameters: RMS over poses and axes of the posterior's standard deviation.

    `u² = mean(diag(J C Jᵀ))` with the covariance C of all parameters, including base and tool, and the derivatives J of
    the positions with respect to them.

    Args:
        model: the model.
        poses: rows with frames and targets of the model.
        rows_name: name of these rows.
    """
    if poses is None or model.uncertainty is None:
        return (
            "parameters of the model: the model stores no posterior, or there are no poses to compute it for."
        )
    deviation = sigma_of_rows(model, poses)
    u = float(deviation[torch.isfinite(deviation)].square().mean().sqrt())
    if math.isnan(u):
        return "parameters of the model: the posterior predicts no position of these poses."
    source = f"posterior of model '{model.name}' at {poses.rows} poses of {rows_name}"
    return Component("parameters of the model", "A", u, _freedom(model), source)


def scatter_component(model: CalibratedModel) -> Component | str:
    """Evaluate the remaining scatter: the standard deviation of a coordinate after the calibration.

    `s² = Σ r² / (n - p)` of the n residuals r with the effective number p of parameters, with `ν = n - p` degrees of
    freedom.
    """
    sigma = math.nan if model.uncertainty is None else model.uncertainty.noise.standard_deviation(_POSITION)
    if math.isnan(sigma):
        return f"{SCATTER}: the calibration did not estimate the standard deviation of a coordinate."
    noise = _noise(model)
    values = "" if noise is None else f" of {noise.value_count} coordinates"
    source = f"residuals{values} of the calibration; repeatability and noise of the instrument included"
    return Component(SCATTER, "A", sigma, _freedom(model), source)


def repeatability_component(repeatability_mm: float | None) -> Component | str:
    """Evaluate the repeatability stated by the manufacturer, for models without residuals that contain it.

    Distances l from the barycentre of independent normal errors with the standard deviation σ along every axis have the
    mean `σ √(8/π)` and the variance `σ² (3 - 8/π)`, so that `RP = l̄ + 3 S_l` of ISO 9283:1998, 7.2.2 is `3.62 σ`.

    Args:
        repeatability_mm: pose repeatability RP [mm]; None if it is not stated.
    """
    if repeatability_mm is None:
        return "repeatability: pose_repeatability_mm in cell.yaml."
    u = repeatability_mm / 1e3 / (math.sqrt(8 / math.pi) + 3 * math.sqrt(3 - 8 / math.pi))
    return Component(
        "repeatability", "B", u, math.inf, f"RP = {repeatability_mm:g} mm of the maker, cell.yaml"
    )


def instrument_component(instrument: Instrument) -> Component | str:
    """Evaluate the uncertainty of the instrument: `u = U / k` of its certificate (JCGM 100:2008, 4.3.3)."""
    U, k = instrument.expanded_uncertainty_mm, instrument.coverage_factor
    if U is None or k is None:
        missing = "expanded_uncertainty_mm" if U is None else "coverage_factor"
        return f"instrument: instrument.{missing} in cell.yaml."
    certificate = f"certificate {instrument.certificate}" if instrument.certificate else "cell.yaml"
    source = f"{certificate}: U = {U:g} mm, k = {k:g}"
    return Component("instrument", "B", U / k / 1e3, math.inf, source)


def thermal_component(
    model: CalibratedModel,
    temperatures: Mapping[str, float | None],
    session_names: Sequence[str],
    expansion_per_k: float | None,
) -> Component | str:
    """Evaluate the thermal expansion that the model does not compensate.

    The coordinate changes by at most `a = α L ΔT` with the reach L of the nominal robot and the largest deviation ΔT of
    a session's mean temperature from that of the calibration, or from the range in which the model corrects for the
    temperature. A uniform distribution between -a and a has `u = a / √3` (JCGM 100:2008, 4.3.7).
    """
    what = "thermal expansion"
    if unknown := [name for name, value in temperatures.items() if value is None]:
        return f"{what}: the temperature of {', '.join(unknown)}."
    if expansion_per_k is None:
        return f"{what}: expansion_per_k in cell.yaml."
    known = {name: value for name, value in temperatures.items() if value is not None}
    first = [known[name] for name in session_names if name in known]
    if not first:
        return f"{what}: the temperature of the calibration."
    mean = sum(first) / len(first)
    low, high = learned_range(model, "temperature_c") or (mean, mean)
    span = max(max(low - value, value - high, 0.0) for value in known.values())
    reference = f"{mean:.1f} deg C of the calibration" if low == high else f"{low:.1f} to {high:.1f} deg C"
    a = expansion_per_k * model.robot.reach * span
    source = f"{expansion_per_k:g} /K, reach {model.robot.reach:.3f} m, sessions up to {span:.1f} K from {reference}"
    return Component(f"uncompensated {what}", "B", a / math.sqrt(3), math.inf, source)


def _noise(model: CalibratedModel) -> NoiseFigures | None:
    """Return the noise figures of coordinates; None if the model does not store them."""
    summary = CalibrationSummary.read(model)
    if summary is None:
        return None
    learned = None if summary.hybrid is None else summary.hybrid.learned
    every = summary.noise if learned is None else learned.noise
    return next((one for one in every if one.sensor == _POSITION and one.value_count is not None), None)


def _freedom(model: CalibratedModel) -> float | None:
    """Return the degrees of freedom of the residuals, `n - p`; None if the model does not store them."""
    noise = _noise(model)
    if noise is None or noise.value_count is None or noise.effective_parameters is None:
        return None
    return max(noise.value_count - noise.effective_parameters, 1.0)
