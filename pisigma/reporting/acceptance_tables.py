"""Acceptance of the robot of a cell as sentences and tables."""

import math
from collections.abc import Sequence

from pisigma.lifetime.cell.acceptance import Acceptance
from pisigma.reporting.result_text import Table
from pisigma.reporting.tables import number_text
from pisigma.validation.iso9283.repeats import MIN_CYCLES, RepeatedPose, pooled_scatter
from pisigma.validation.uncertainty.budget import COVERAGE

_NOT_STATED = "not stated"
_SHARE = f"{100 * COVERAGE:.0f} %"


def acceptance_sentences(acceptance: Acceptance) -> tuple[str, ...]:
    """Return sentences on the predicted budget, the measured errors, the limit, and who accepted the model."""
    budget, measured, lines = acceptance.budget, acceptance.measured, list[str]()
    if budget.components:
        start = f"With the stated components alone, {_SHARE}" if budget.missing_components else _SHARE
        U, k, radius = budget.expanded_uncertainty * 1e3, budget.coverage_factor, budget.coverage_radius * 1e3
        lines.append(
            f"{start} of the positions are expected within {radius:.3f} mm of the commanded ones; the expanded "
            f"uncertainty of a coordinate is U = {U:.3f} mm (k = {k:.2f})."
        )
    if measured is not None:
        lines.append(
            f"{_SHARE} of the {measured.rows} measured positions of session {measured.session} were within "
            f"{measured.errors.statistics['p95']:.3f} mm."
        )
    if acceptance.limit_mm is not None:
        lines.append(f"The limit is {acceptance.limit_mm:g} mm.")
    if measured is not None and measured.fitted_frames:
        several = len(measured.fitted_frames) > 1
        lines.append(
            f"The {' and the '.join(measured.fitted_frames)} {'were' if several else 'was'} fitted to these rows, "
            f"because {'they were' if several else 'it was'} changed."
        )
    if measured is not None and measured.distrust_reason:
        lines.append(measured.distrust_reason)
    if acceptance.is_contradicted:
        lines.append(contradiction_sentence(acceptance))
    of_model = [one for one in acceptance.acceptance_events if one.model == acceptance.model]
    lines.append(
        of_model[-1].sentence if of_model else f"Nobody has accepted model '{acceptance.model}' yet."
    )
    return tuple(lines)


def contradiction_sentence(acceptance: Acceptance) -> str:
    """Return a sentence if the measured errors are larger than the budget explains; "" otherwise."""
    session = "" if acceptance.measured is None else f" of session {acceptance.measured.session}"
    return (
        f"The measured errors{session} are larger than the budget explains: the budget lacks a component, or the "
        "robot has changed since its calibration."
    )


def statement_table(acceptance: Acceptance) -> tuple[tuple[str, str], ...]:
    """Return the statements about instrument, robot and temperatures, by name."""
    instrument, span = acceptance.instrument, acceptance.temperature_span
    U, k = instrument.expanded_uncertainty_mm, instrument.coverage_factor
    maker, scatter = acceptance.repeatability_mm, pooled_scatter(acceptance.repeats)
    return (
        ("instrument", instrument.name or _NOT_STATED),
        ("serial number", instrument.serial or _NOT_STATED),
        ("certificate", instrument.certificate or _NOT_STATED),
        ("calibrated on", instrument.calibrated or _NOT_STATED),
        (
            "uncertainty of a coordinate",
            f"U = {_NOT_STATED if U is None else f'{U:g} mm'}, k = {_NOT_STATED if k is None else f'{k:g}'}",
        ),
        ("repeatability RP of the maker", _NOT_STATED if maker is None else f"{maker:g} mm"),
        (
            "standard deviation of a coordinate in repeated poses",
            "no pose was measured twice"
            if scatter is None
            else f"{number_text(scatter[0] * 1e3)} mm ({scatter[1]} degrees of freedom)",
        ),
        (
            "temperatures of the sessions",
            _NOT_STATED if span is None else f"{span[0]:.1f} to {span[1]:.1f} deg C",
        ),
    )


def budget_table(acceptance: Acceptance) -> Table:
    """Return the components of the budget with their standard uncertainties, and the combined figures below them."""
    budget = acceptance.budget
    rows: list[tuple[str, ...]] = [
        (
            one.name,
            one.evaluation,
            number_text(one.standard_uncertainty * 1e3),
            _freedom(one.degrees_of_freedom),
            one.source,
        )
        for one in budget.components
    ]
    rows += [
        (line.partition(":")[0], "", _NOT_STATED, "", line.partition(": ")[2])
        for line in budget.missing_components
    ]
    if budget.components:
        freedom, k = budget.effective_degrees_of_freedom, budget.coverage_factor
        rows += [
            (
                "combined",
                "",
                number_text(budget.combined_uncertainty * 1e3),
                _freedom(freedom),
                "root of the sum of squares",
            ),
            ("expanded", "", number_text(budget.expanded_uncertainty * 1e3), "", f"k = {k:.3f} for {_SHARE}"),
        ]
    return Table(
        ("component", "type", "standard uncertainty [mm]", "degrees of freedom", "source"), tuple(rows)
    )


def comparison_table(acceptance: Acceptance) -> Table:
    """Return predicted figures next to figures of a session to which the model was not fitted [mm]."""
    budget, measured = acceptance.budget, acceptance.measured
    predicted: Sequence[float] = (math.nan,) * 3
    if budget.components:
        predicted = [
            1e3 * value
            for value in (budget.combined_uncertainty, budget.expanded_uncertainty, budget.coverage_radius)
        ]
    found: Sequence[float] = (math.nan,) * 4
    if measured is not None:
        statistics = measured.errors.statistics
        found = (
            statistics["rms"] / math.sqrt(3),
            measured.coordinate_p95_mm,
            statistics["p95"],
            statistics["max"],
        )
    names = (
        "one coordinate, RMS",
        "one coordinate, 95 % within",
        "position, 95 % within",
        "position, largest",
    )
    return Table(
        ("error [mm]", "budget", "measured"),
        tuple(
            (name, _figure(here), _figure(there))
            for name, here, there in zip(names, (*predicted, math.nan), found, strict=True)
        ),
    )


def iso_table(repeats: Sequence[RepeatedPose]) -> Table:
    """Return pose accuracy and repeatability of the poses that were measured more than once [mm]."""
    accuracies = [one.accuracy * 1e3 for one in repeats if one.accuracy is not None]
    repeatabilities = [one.repeatability * 1e3 for one in repeats if one.repeatability is not None]
    names: tuple[tuple[str, list[float], int], ...] = (
        ("pose accuracy AP", accuracies, 2),
        (f"pose repeatability RP, {MIN_CYCLES} cycles or more", repeatabilities, MIN_CYCLES),
        ("path accuracy AT and path repeatability RT", [], 2),  # the sessions of a cell contain no paths
    )
    rows: list[tuple[str, ...]] = []
    for name, values, fewest in names:
        cycles = sorted({one.rows for one in repeats if one.rows >= fewest})
        if values:
            counts = f"{cycles[0]} to {cycles[-1]}" if len(cycles) > 1 else f"{cycles[0]}"
            mean = sum(values) / len(values)
            rows.append((name, str(len(values)), counts, number_text(mean), number_text(max(values))))
        else:
            rows.append((name, "0", "", _NOT_STATED, _NOT_STATED))
    return Table(("ISO 9283:1998", "poses", "cycles", "mean [mm]", "largest [mm]"), tuple(rows))


def _freedom(value: float | None) -> str:
    if value is None:
        return "not known"
    return "infinite" if math.isinf(value) else f"{value:.0f}"


def _figure(value: float) -> str:
    return "" if math.isnan(value) else number_text(value)
