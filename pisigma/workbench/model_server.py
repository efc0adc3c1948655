"""`pisigma serve` for a cell, as a separate process, so that answers do not wait for computations of the page."""

import json
import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

from pisigma.files.errors import ModelError, Place
from pisigma.robot.description import Robot

_TIMEOUT = 2.0
"""Longest time to wait for an answer from the server [s]."""
_WARM_UP = 100
"""Number of requests that are sent after the start; their times are the first that the page displays."""


class ModelServer:
    """Server that answers with the model in use of a cell; it can be started and stopped.

    Attributes:
        ports: ports by protocol; empty while the server is stopped.
    """

    def __init__(self, folder: Path) -> None:
        """Prepare a server that is stopped.

        Args:
            folder: folder of the cell.
        """
        self._folder, self._lock = folder, threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self.ports: dict[str, int] = {}

    def start(self, robot: Robot) -> None:
        """Start the server if it is not running, and measure the times of its first answers.

        Args:
            robot: robot of the cell.

        Raises:
            ModelError: no model is in use, or the model cannot be served; see `pisigma serve`.
        """
        with self._lock, tempfile.TemporaryFile("w+") as said:
            if self._process is not None and self._process.poll() is None:
                return
            command = [sys.executable, "-m", "pisigma", "serve", str(self._folder)]
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=said, text=True
            )
            assert self._process.stdout is not None
            if not (line := self._process.stdout.readline()):
                self._process.wait()
                said.seek(0)
                problem = said.read().strip().removeprefix("pisigma: ").rstrip(".")
                raise ModelError(problem or "the server did not start", at=Place(self._folder))
            self.ports = json.loads(line)
        there = self._ask([{"q_deg" if all(robot.revolute) else "q": [0.0] * len(robot.axes)}])[0]
        self._ask([{"pose": there["pose"]}] * _WARM_UP if "pose" in there else [])

    def stop(self) -> None:
        """Stop the server after it has answered all received requests."""
        with self._lock:
            if self._process is not None:
                self._process.terminate()
                self._process.wait()
            self._process, self.ports = None, {}

    def health(self) -> dict[str, Any]:
        """Return counts and times of the answers, see `MetricsSummary`; empty while the server is stopped."""
        if self._process is None or self._process.poll() is not None or not self.ports:
            return {}
        return self._ask([{"ask": "health"}])[0]

    def _ask(self, requests: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Send requests and return the answers, which are empty if the server does not answer."""
        try:
            with socket.create_connection(("127.0.0.1", self.ports["json_port"]), _TIMEOUT) as stream:
                answers = stream.makefile("r", encoding="utf-8")
                found = []
                for number, request in enumerate(requests):
                    stream.sendall(json.dumps({"id": number, **request}).encode() + b"\n")
                    found.append(json.loads(answers.readline()))
                return found
        except (OSError, ValueError):
            return [{} for _ in requests]
