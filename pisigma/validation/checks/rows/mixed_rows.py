"""Whether only some of the rows agree with a model, and the others with something else."""

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

MOST_WRONG = 0.25
"""Share of the rows beyond which it is not known which of them are wrong."""
FEWEST_AGREEING = 0.35
"""Share of the rows that agree with the model where the others are of something else."""
AGREES = 3.5
"""Rows agree with a model that are within so many times of what it and the sensor usually err."""
APART = 2.0
"""Rows are of something else that are farther off than those that agree by this factor at least."""
FAR_APART = 6.0
"""The typical errors of both differ by this factor at least."""
BETWEEN = 0.15
"""Share of the rows that may be neither near nor far."""
DRAWS, SAMPLE = 100, 4
"""Small sets of rows to which a base or a tool is fitted, besides halves of the file and every second row."""
SPARE_ROWS = 3
"""Rows beyond those of a set that agree with what was fitted to it."""
ADVICE = " Nothing is concluded from them together; measure again, or give each group a file or a frame of its own."
EXPLAINED = 2.5
"""Errors of usual size, where moved zeros of the joints explain them."""


class MixedRowsCheck(AbstractRowCheck):
    """Looks for the largest set of rows that agrees with the model, the base or the tool being as it is or anywhere.

    Bases and tools are fitted to small sets of rows, as in Fischler and Bolles 1981, Communications of the ACM 24(6).
    Where a quarter or more of the rows are far off what the others agree on to the noise, rows of two setups are
    mixed, or nobody knows which are wrong. Zeros of the joints that have moved make errors of all sizes, and are fitted
    to all rows first.
    """

    def diagnose(self, judged: RowsUnderModel) -> Iterator[Diagnostic]:
        """See `AbstractRowCheck.diagnose`."""
        if not bool(torch.isfinite(judged.usual).all()):
            return
        found = [one for one in (_apart(judged, T) for T in _agreements(judged)) if one is not None]
        if found and not _joints_explain(judged):
            yield mixed_rows(judged, min(found, key=lambda far: int(far.sum())))


def mixed_rows(judged: RowsUnderModel, wrong: Bool[Tensor, " rows"]) -> Diagnostic:
    """Say that so many rows do not agree with the others, and what distinguishes them."""
    found = many_wrong(judged.rows, wrong)
    sentence = f"{found.sentence.removesuffix(ADVICE)}{_cause(judged, wrong)}{ADVICE}"
    return found.model_copy(update={"sentence": sentence})


def many_wrong(rows: Measurements, wrong: Bool[Tensor, " rows"]) -> Diagnostic:
    """Say that more rows are wrong than can be left out."""
    return Diagnostic(
        kind="mixed_rows",
        severity="implausible",
        sentence=f"{int(wrong.sum())} of {rows.rows} rows do not agree with the others: "
        f"{what_distinguishes(rows, wrong)}.{ADVICE}",
        rows=tuple(rows.place(row) for row in wrong.nonzero()[:, 0].tolist()),
    )


def _cause(judged: RowsUnderModel, wrong: Bool[Tensor, " rows"]) -> str:
    """Say what explains the rows that are wrong, where something does."""
    faults = find_setup_faults(judged.model, None, judged.rows.select(wrong), judged.fitted)
    if not faults:
        return ""
    fault = either(faults)
    fall = joined(length_text(error) for error in (fault.before, fault.after))
    return f" In them {fault.clause} (errors before and after: {fall})."


def _agreements(judged: RowsUnderModel) -> Iterator[Float64[Tensor, "rows 4 4"]]:
    """Poses as they are predicted, and with a base or a tool that agrees with as many rows as possible."""
    if not judged.fitted:
        yield judged.drawn
    if len(set(judged.rows.frame)) > 1 or len(set(judged.rows.target)) > 1:
        return
    limit = AGREES * judged.usual
    samples = list(_samples(judged.rows.rows))
    for kind in ("base", "tool"):
        best, most = None, SAMPLE + SPARE_ROWS - 1
        for sample in samples:
            chosen = sample
            for _ in range(3):
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
    """Halves of the file, every second row, and small sets drawn from all."""
    every, draw = torch.arange(rows), torch.Generator().manual_seed(0)
    yield from (every[: rows // 2], every[rows // 2 :], every[::2], every[1::2])
    for _ in range(DRAWS):
        yield torch.randperm(rows, generator=draw)[:SAMPLE]


def _fitted(judged: RowsUnderModel, kind: str, chosen: Tensor) -> Float64[Tensor, "rows 4 4"]:
    """Predicted poses with the base or the tool that suits some rows."""
    some, measured = judged.drawn[chosen], judged.measured.select(chosen)
    if kind == "base":
        return best_base(some, measured) @ judged.drawn
    return judged.drawn @ best_tool(some, measured)


def _apart(judged: RowsUnderModel, T: Float64[Tensor, "rows 4 4"]) -> Bool[Tensor, " rows"] | None:
    """Rows that are far from what the others agree on; None where these are few, or are not clearly apart."""
    ratio = judged.lengths(T) / (AGREES * judged.usual)
    near, far = ratio <= 1, ratio > APART
    count = judged.rows.rows
    if not int(far.sum()) > MOST_WRONG * count or not int(near.sum()) >= FEWEST_AGREEING * count:
        return None
    if int((~near & ~far).sum()) > BETWEEN * count:
        return None
    return far if float(ratio[far].median()) > FAR_APART * float(ratio[near].median()) else None


def _joints_explain(judged: RowsUnderModel) -> bool:
    """Whether zeros of the joints that have moved, beside a base, explain all rows."""
    known, error = judged.known, (judged.measured.position - judged.predicted[:, :3, 3])
    columns = []
    for joint in range(known.dof):
        moved = known.q.clone()
        moved[:, joint] += STEP
        there = poses_of_rows(judged.model, Measurements(moved, frame=known.frame, target=known.target))
        columns.append((there - judged.drawn)[:, :3, 3] / STEP)
    J = torch.stack(columns, -1).flatten(0, 1)
    solution = torch.linalg.lstsq(J, error.flatten(), driver="gelsd").solution
    left = (error.flatten() - J @ solution).view(-1, 3).norm(dim=-1)
    return float((left / judged.usual).square().mean().sqrt()) <= EXPLAINED
