"""Fit one method to one task in a process of its own: `python worker.py METHOD TASK.npz PREDICTION.npz LIMIT_S`.

It prints one JSON object: the status and, if the fit succeeded, processor time, memory and versions.
"""

import importlib.metadata
import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from shared_benchmark.methods import method_of
from shared_benchmark.rows import Method, Task


def run(method: Method, task: Task, out: Path) -> dict[str, Any]:
    """Fit, predict the held-out rows, and store the prediction."""
    try:
        versions = {name: importlib.metadata.version(name) for name in method.packages}
    except importlib.metadata.PackageNotFoundError as problem:
        return {"status": f"not installed: {problem.name}"}
    began, clock = time.process_time(), time.monotonic()
    try:
        predict = method.fit(task)
        seconds, elapsed = time.process_time() - began, time.monotonic() - clock
        prediction = predict(task.test)
    except Exception as problem:  # any exception of a peer is its result
        text = str(problem).splitlines()
        return {"status": f"failed: {type(problem).__name__}: {text[0][:100] if text else ''}"}
    if not np.isfinite(prediction.T[:, :3, 3]).all():
        return {"status": "failed: a predicted position is not finite"}
    sigma = np.full((len(prediction.T), 3), np.nan) if prediction.sigma is None else prediction.sigma
    np.savez(out, T=prediction.T, sigma=sigma)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    times = {"seconds": seconds, "elapsed_seconds": elapsed}
    return {"status": "done", **times, "memory_mb": memory, "versions": versions}


def main() -> None:
    """Limit the processor time, and run."""
    name, task, out, limit = sys.argv[1:]
    resource.setrlimit(resource.RLIMIT_CPU, (int(limit), int(limit) + 5))
    done = run(method_of(name), Task.load(Path(task)), Path(out))
    print(json.dumps(done))


if __name__ == "__main__":
    main()
