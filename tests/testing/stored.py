"""Results of slow functions, computed once for all processes of a test run."""

import functools
import hashlib
import inspect
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

FOLDER = "PISIGMA_TEST_RESULTS"
"""Environment variable with the folder of the results of this run, which `conftest.py` sets for several processes."""

Function = TypeVar("Function", bound=Callable[..., Any])


def stored(function: Function) -> Function:
    """Compute a function once for equal arguments, whether these are stated or defaults, by position or by name.

    Its arguments must have a `repr` that states all of their value, and its results must be picklable.
    """
    signature, known = inspect.signature(function), dict[str, Any]()

    @functools.wraps(function)
    def once(*arguments: Any, **named: Any) -> Any:
        bound = signature.bind(*arguments, **named)
        bound.apply_defaults()
        key = f"{function.__module__}.{function.__qualname__}({bound.arguments!r})"
        if key not in known:
            known[key] = _of_run(key, lambda: function(*arguments, **named))
        return known[key]

    return once  # type: ignore[return-value]


def _of_run(key: str, compute: Callable[[], Any]) -> Any:
    """Return what a process of this run has stored, else compute and store it."""
    if FOLDER not in os.environ:
        return compute()
    path = Path(os.environ[FOLDER]) / hashlib.sha256(key.encode()).hexdigest()
    if path.exists():
        return pickle.loads(path.read_bytes())
    result = compute()
    written = path.with_suffix(f".{os.getpid()}")
    written.write_bytes(pickle.dumps(result))
    written.replace(path)
    return result
