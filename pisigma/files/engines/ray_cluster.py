"""Engine that uses a Ray cluster, or Ray's workers on this machine."""

import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from pisigma.files.engines.engine import (
    ONE_THREAD,
    AbstractEngine,
    Item,
    Result,
    pack_arguments,
    process_chunk,
    unpack_results,
)


class RayEngine(AbstractEngine):
    """Engine that runs a function as Ray tasks of one core; all machines must see the files under the same paths."""

    def __init__(self, workers: int | None, address: str | None = None) -> None:
        """Start Ray on this machine, or join a cluster.

        Args:
            workers: number of workers on this machine; None for one per core. Ignored for a cluster.
            address: address of a cluster, such as "auto" or "ray://head:10001"; None for this machine.

        Raises:
            ImportError: Ray is not installed.
        """
        import ray

        self._ray: Any = ray  # most functions of Ray have no types
        stated = {"address": address} if address else {"num_cpus": workers}
        variables = ONE_THREAD if address else {**ONE_THREAD, "PYTHONPATH": os.pathsep.join(sys.path)}
        self._ray.init(
            log_to_driver=False, logging_level=logging.ERROR, runtime_env={"env_vars": variables}, **stated
        )
        self._workers = max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    @property
    def workers(self) -> int:
        """Number of cores of the cluster."""
        return self._workers

    def close(self) -> None:
        """Leave the cluster, or stop Ray on this machine."""
        self._ray.shutdown()

    def _chunks(
        self, work: Callable[[Item], Result], chunks: Sequence[Sequence[Item]]
    ) -> Iterator[tuple[Sequence[Item], list[Result] | None]]:
        """See `AbstractEngine`."""
        task = self._ray.remote(num_cpus=1, max_retries=0)(process_chunk)
        running = {task.remote(*pack_arguments(work, chunk)): chunk for chunk in chunks}
        while running:
            (ended,), _ = self._ray.wait(list(running), num_returns=1)
            chunk = running.pop(ended)
            try:
                yield chunk, unpack_results(self._ray.get(ended))
            except (self._ray.exceptions.WorkerCrashedError, self._ray.exceptions.OutOfMemoryError):
                yield chunk, None
