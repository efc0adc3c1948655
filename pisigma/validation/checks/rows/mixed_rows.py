"""Whether only some of the rows agree with a model, and the others belong to another setup."""

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.robot.frame_fits import best_base, best_tool
from pisigma.validation.checks.rows.distinguishing import what_distinguishes
from pisigma.validation.checks.rows.row_check import STEP, AbstractRowCheck, RowsUnderModel
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.cause import joined, length_text
from pisigma.validation.setup_faults.setup_fault import either
from pisigma.validation.setup_faults.setup_faults import find_setup_faults

MIN_WRONG_SHARE = 0.25
"""Share of the rows above which it is not known which of them are wrong."""
MIN_AGREEING_SHARE = 0.35
"""Share of the rows that must agree with the model."""
AGREES = 3.5
"""Error over the expected one (model and sensor) up to which a row agrees with a model."""
APART = 2.0
"""Multiple of the limit `AGREES` above which a row belongs to another setup."""
FAR_APART = 6.0
"""Ratio of the median errors of both groups."""
BETWEEN = 0.15
"""Share of the rows that may be neither near nor far."""
DRAWS, SAMPLE = 100, 4
"""Number and size of the random samples that a base or a tool is fitted to, as are halves and every second row."""
SPARE_ROWS = 3
"""Rows that must agree with a fit in addition to those of its sample."""
ADVICE = " No result is computed from all of them; measure again, or give each group its own file or frame."
EXPLAINED = 2.5
"""Error over the expected one up to which moved joint zeros explain all rows."""


class MixedRowsCheck(AbstractRowCheck):
    """Looks for the largest set of rows that agrees with the model, with its base or tool as they are or fitted.

    Bases and tools are fitted to random samples of rows (RANSAC: Fischler and Bolles 1981, Communications of the ACM
    24(6)). If more than a quarter of the rows are far off while the others agree to the noise, rows of two setups are
    mixed, or it is not known which are wrong. Moved joint zeros cause errors of all sizes, so they are fitted to all
    rows first.
    """

    def diagnose(self, judged: RowsUnderModel) -> Iterator[Diagnostic]:
        """See `AbstractRowCheck.diagnose`."""
        if not bool(torch.isfinite(judged.usual).all()):
            return
        found = [one for one in (_apart(judged, T) for T in _agreements(judged)) if one is not None]
        if found and not _joints_explain(judged):
            yield mixed_rows(judged, min(found, key=lambda far: int(far.sum())))


def mixed_rows(judged: RowsUnderModel, wrong: Bool[Tensor, " rows"]) -> Diagnostic:
    """Report that some rows do not agree with the others, what distinguishes them, and what explains them."""
    found = many_wrong(judged.rows, wrong)
    sentence = f"{found.sentence.removesuffix(ADVICE)}{_cause(judged, wrong)}{ADVICE}"
    return found.model_copy(update={"sentence": sentence})


def many_wrong(rows: Measurements, wrong: Bool[Tensor, " rows"]) -> Diagnostic:
    """Report that more rows are wrong than can be left out."""
    distinction = what_distinguishes(rows, wrong)
    return Diagnostic(
        kind="mixed_rows",
        severity="implausible",
        sentence=f"{int(wrong.sum())} of {rows.rows} rows do not agree with the others: "
        f"{distinction.clause}.{ADVICE}",
        rows=tuple(rows.place(row) for row in wrong.nonzero()[:, 0].tolist()),
        values={"distinguished_by": distinction.by},
    )


def _cause(judged: RowsUnderModel, wrong: Bool[Tensor, " rows"]) -> str:
    """Say what explains the wrong rows; empty if nothing does."""
    faults = find_setup_faults(judged.model, None, judged.rows.select(wrong), judged.fitted)
    if not faults:
        return ""
    fault = either(faults)
    fall = joined(length_text(error) for error in (fault.before, fault.after))
    return f" In these rows, {fault.clause} (errors without and with this correction: {fall})."


def _agreements(judged: RowsUnderModel) -> Iterator[Float64[Tensor, "rows 4 4"]]:
    """Yield the predicted poses, and those with a base or a tool that agrees with as many rows as possible."""
    if not judged.fitted:
        yield judged.unfitted
    if len(set(judged.rows.frame)) > 1 or len(set(judged.rows.target)) > 1:
        return
    limit = AGREES * judged.usual
    samples = list(_samples(judged.rows.rows))
    for kind in ("base", "tool"):
        best, most = None, SAMPLE + SPARE_ROWS - 1
        for sample in samples:
            chosen = sample
            for _ in range(3):  # local optimisation: refit to all rows that agree
                T = _fitted(judged, kind, chosen)
                agreeing = judged.lengths(T) <= limit
                chosen = agreeing.nonzero()[:, 0]
                if len(chosen) < SAMPLE:
                    break
            if int(agreeing.sum()) > most:
                best, most = T, int(agreeing.sum())
        if best is not None:
            yield best


def _samples(rows: int) -> Iterator[Tensor]:
    """Yield halves of the file, every second row, and small random samples."""
    every, draw = torch.arange(rows), torch.Generator().manual_seed(0)
    yield from (every[: rows // 2], every[rows // 2 :], every[::2], every[1::2])
    for _ in range(DRAWS):
        yield torch.randperm(rows, generator=draw)[:SAMPLE]


def _fitted(judged: RowsUnderModel, kind: str, chosen: Tensor) -> Float64[Tensor, "rows 4 4"]:
    """Predict the poses with the base or the tool fitted to some rows."""
    some, measured = judged.unfitted[chosen], judged.measured.select(chosen)
    if kind == "base":
        return best_base(some, measured) @ judged.unfitted
    return judged.unfitted @ best_tool(some, measured)


def _apart(judged: RowsUnderModel, T: Float64[Tensor, "rows 4 4"]) -> Bool[Tensor, " rows"] | None:
    """Find the rows that are far from what the others agree on; None if these are few or not clearly separated."""
    ratio = judged.lengths(T) / (AGREES * judged.usual)
    near, far = ratio <= 1, ratio > APART
    count = judged.rows.rows
    if not int(far.sum()) > MIN_WRONG_SHARE * count or not int(near.sum()) >= MIN_AGREEING_SHARE * count:
        return None
    if int((~near & ~far).sum()) > BETWEEN * count:
        return None
    return far if float(ratio[far].median()) > FAR_APART * float(ratio[near].median()) else None


def _joints_explain(judged: RowsUnderModel) -> bool:
    """Say whether moved joint zeros explain all rows (linearised at the fitted poses)."""
    known, error = judged.known, (judged.measured.position - judged.predicted[:, :3, 3])
    columns = []
    for joint in range(known.dof):
        moved = known.q.clone()
        moved[:, joint] += STEP
        there = poses_of_rows(judged.model, Measurements(moved, frame=known.frame, target=known.target))
        columns.append((there - judged.unfitted)[:, :3, 3] / STEP)
    J = torch.stack(columns, -1).flatten(0, 1)
    solution = torch.linalg.lstsq(J, error.flatten(), driver="gelsd").solution
    left = (error.flatten() - J @ solution).view(-1, 3).norm(dim=-1)
    return float((left / judged.usual).square().mean().sqrt()) <= EXPLAINED
