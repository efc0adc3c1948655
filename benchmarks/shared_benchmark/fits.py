"""Run the methods on the folds of a series, one process per fit, and compare predictions with the held-out rows."""

import ast
import hashlib
import json
import math
import os
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from shared_benchmark.public_series import Series
from shared_benchmark.rows import Method, Prediction, Rows, Task
from shared_benchmark.scores import RowErrors, errors_between_sockets, row_errors
from shared_benchmark.series import series_of
from shared_benchmark.splits import SEED, Fold, folds_of

LIMIT_S = 300
"""Largest processor time of a fit [s], with one thread."""
PATIENCE = 6
"""Ratio of elapsed time to the limit above which a fit that waits for other programs is ended."""
WAITED = "ended after"
"""First words of the status of such a fit, which is run again."""
REPOSITORY = Path(__file__).parents[2]
PACKAGE = Path(__file__).parent
ROOMS = (
    "files",
    "robot",
    "estimation",
    "measurement",
    "network",
    "joint_correction",
    "simulation",
    "calibration",
)
"""Rooms of pisigma that a calibration may import; the others come later in the order of imports."""

Fit = dict[str, Any]
"""Stored values of a fit, by column."""


def code_hash(method: Method, series: Series) -> str:
    """Return the SHA-256 of the nominal arm and of the code that determines what a method predicts."""
    files = {PACKAGE / "rows.py", *_with_imports(PACKAGE / "methods" / f"{method.name}.py")}
    if "pisigma" in method.packages:
        files |= {path for room in ROOMS for path in (REPOSITORY / "pisigma" / room).rglob("*.py")}
    digest = hashlib.sha256(np.round(series.arm.dh, 9).tobytes())
    for path in sorted(files):
        digest.update(path.relative_to(REPOSITORY).as_posix().encode() + b"\0")
        digest.update(_code(path.read_text(encoding="utf-8")).encode())
    return digest.hexdigest()


def _code(source: str) -> str:
    """Return the code of a module, which does not contain its comments and docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [one for one in node.body if not _is_text(one)]
    return ast.unparse(tree)


def _is_text(node: ast.stmt) -> bool:
    """Return whether a statement is a docstring, or the description of a constant or a field."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _with_imports(path: Path) -> set[Path]:
    """Return a file of `methods/` and the shared files that it imports."""
    text = path.read_text(encoding="utf-8")
    shared = [other for other in path.parent.glob("_[a-z]*.py") if f"methods.{other.stem} import" in text]
    return {path}.union(*map(_with_imports, shared))


def predict(task: Task, method: str, python: str) -> tuple[Fit, Prediction | None]:
    """Fit and predict in a new process; a crash or an overrun is returned as status."""
    paths = [str(REPOSITORY / "benchmarks"), str(REPOSITORY)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    environment |= {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        given, out = Path(folder) / "task.npz", Path(folder) / "prediction.npz"
        task.save(given)
        command = [python, str(PACKAGE / "worker.py"), method, str(given), str(out), str(LIMIT_S)]
        try:
            done = subprocess.run(
                command,
                env=environment,
                capture_output=True,
                text=True,
                check=False,
                timeout=PATIENCE * LIMIT_S,
            )
        except subprocess.TimeoutExpired:
            return {"status": f"{WAITED} {PATIENCE * LIMIT_S} s of other programs"}, None
        if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
            return {"status": f"over {LIMIT_S} s"}, None
        if done.returncode:
            last = (done.stderr.strip().splitlines() or [""])[-1]
            return {"status": f"failed: exit status {done.returncode}: {last[:100]}"}, None
        fit: Fit = json.loads(done.stdout.strip().splitlines()[-1])
        fit["versions"] = json.dumps(fit.get("versions", {}))
        if fit["status"] != "done":
            return fit, None
        with np.load(out) as stored:
            return fit, Prediction(stored["T"], stored["sigma"])


def fits_of(
    series: Series, split: str, method: Method, python: str, folds: int | None = None, below: float = math.inf
) -> Iterator[tuple[Fit, RowErrors | None]]:
    """Run a method on the folds of a split.

    Args:
        series: the series.
        split: name of the split.
        method: the method.
        python: Python that runs the method.
        folds: number of folds to run, starting with the first; None for all.
        below: smallest number of training rows of folds that are not tried because a fit overran; an overrun lowers it.
    """
    inputs = inputs_of(series, split, method)
    for number, fold in enumerate(folds_of(series, split)[:folds]):
        base = {**inputs, "fold": number, "train_rows": len(fold.train)}
        if series.measured not in method.measured:
            yield {**base, "status": f"does not use rows of the kind '{series.measured}'"}, None
            return
        if len(fold.train) >= below:
            yield {**base, "status": f"not tried after an overrun with {below} rows"}, None
            continue
        task, test, test_series = make_task(series, split, fold)
        fit, prediction = predict(task, method.name, python)
        if fit["status"].startswith("over "):
            below = len(fold.train)
        if prediction is None:
            yield {**base, **fit}, None
            continue
        if split == "session" and not np.isfinite(prediction.T).all():
            yield {**base, "status": "predicts no rotations, to which base and tool could be fitted"}, None
            continue
        numbers = np.arange(len(test.q)) if split == "session" else fold.test
        errors = row_errors(test_series, prediction, test, numbers, split == "session")
        distance = errors_between_sockets(prediction, test, test_series.known_distances(test))
        yield {**base, **fit, "distance_mm": distance}, errors


def inputs_of(series: Series, split: str, method: Method) -> Fit:
    """Return what decides the results of a split: its names, the hashes of data, split and code, and the seed."""
    return {
        "series": series.name,
        "split": split,
        "method": method.name,
        "data_sha256": series.sha256,
        "split_sha256": series.splits[split],
        "code_sha256": code_hash(method, series),
        "seed": SEED,
    }


def overrun_rows(fits: list[Fit]) -> float:
    """Return the smallest number of training rows of the fits that overran; infinite if there are none."""
    return min((fit["train_rows"] for fit in fits if fit["status"].startswith("over ")), default=math.inf)


def make_task(series: Series, split: str, fold: Fold) -> tuple[Task, Rows, Series]:
    """Return the task of a method, the held-out rows with their measurements, and the series of these rows."""
    rows, arm = series.rows(), series.arm
    train, test, test_series = rows.select(fold.train), rows.select(fold.test), series
    if split == "session":
        assert series.other_session is not None
        test_series = series_of(series.other_session)
        test = test_series.rows()
    direction = np.array([0.0 if row.type == "fixed" else row.direction for row in arm.rows])
    known = series.known_distances(train)
    return (
        Task(series.name, arm.dh, direction, train, test.without_measurements(), known, SEED),
        test,
        test_series,
    )
