"""Hostile clients against `pisigma serve` as a process: broken streams, clients that stall, and a kill in the middle.

`python tests/hostile/serve.py [MODEL] --streams 5000 --clients 200 [--seed 1]`

Meanwhile a good client sends requests all the time; each answer has to be right, and none may be missing except
while the server is down.
"""

import argparse
import json
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from hostile.streams import PROTOCOLS, check, exchange, good_stream, hostile_stream

import pisigma


class Serving:
    """A server that is killed and started again at the same ports."""

    def __init__(self, model: str) -> None:
        self.model, self.ports = model, {"json_port": 0, "binary_port": 0}
        self.start()

    def start(self) -> None:
        """Start, and wait until it is ready."""
        options = "--port", str(self.ports["json_port"]), "--binary-port", str(self.ports["binary_port"])
        command = [sys.executable, "-m", "pisigma", "serve", self.model, *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE)
        self.ports = json.loads(self.process.stdout.readline())

    def port(self, protocol: str) -> int:
        """Return the port of a protocol."""
        return self.ports[f"{protocol}_port"]

    def memory(self) -> float:
        """Memory of the process [MB]."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return next(int(line.split()[1]) / 1e3 for line in status.splitlines() if line.startswith("VmRSS"))


class GoodClient(threading.Thread):
    """Sends requests all the time, and counts the answers."""

    def __init__(self, serving: Serving, ik: pisigma.CorrectedIK) -> None:
        super().__init__(daemon=True)
        self.serving, self.ik, self.outcomes, self.stopped = serving, ik, Counter(), False

    def run(self) -> None:
        """Ask until it is stopped."""
        rng = random.Random(7)
        while not self.stopped:
            protocol = rng.choice(PROTOCOLS)
            stream = good_stream(rng, protocol, self.ik, 3)
            try:
                received, whole = exchange(random.Random(1), self.serving.port(protocol), stream)
            except OSError:
                self.outcomes["not served"] += 1
                time.sleep(0.05)
                continue
            self.outcomes[check(protocol, stream, received, whole, self.ik) or "right"] += 1


def stalled(rng: random.Random, serving: Serving, ik: pisigma.CorrectedIK) -> socket.socket:
    """Return a client that has sent a part of its requests and then stalls."""
    protocol = rng.choice(PROTOCOLS)
    stream = good_stream(rng, protocol, ik, 2)
    client = socket.create_connection(("127.0.0.1", serving.port(protocol)), 30)
    client.sendall(stream[: rng.randrange(len(stream))])
    return client


def main() -> int:
    """Run all checks, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", default="models/kiro4")
    parser.add_argument("--streams", type=int, default=5000)
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng, ik, serving = random.Random(options.seed), pisigma.load(options.model), Serving(options.model)
    good, bad, before = GoodClient(serving, ik), [], serving.memory()
    good.start()
    for number in range(options.streams):
        protocol = PROTOCOLS[number % 2]
        stream = hostile_stream(rng, protocol, ik)
        received, whole = exchange(rng, serving.port(protocol), stream)
        if problem := check(protocol, stream, received, whole, ik):
            bad.append(f"{number}, {protocol}: {problem}")
    print(
        f"{options.streams} streams: {len(bad)} answered wrongly; memory {before:.1f} -> {serving.memory():.1f} MB"
    )
    print(*bad, sep="\n", end="")
    silent = [stalled(rng, serving, ik) for _ in range(options.clients)]
    time.sleep(2.0)
    print(f"{len(silent)} clients stalled; the good client: {dict(good.outcomes)}")
    serving.process.send_signal(signal.SIGKILL)
    serving.process.wait()
    served = good.outcomes["right"]
    serving.start()
    time.sleep(2.0)
    again = good.outcomes["right"] - served
    print(f"killed and started again with {len(silent)} clients connected: {again} right answers since")
    for client in silent:
        client.close()
    serving.process.send_signal(signal.SIGTERM)
    ended = serving.process.wait(10)
    good.stopped = True
    print(f"SIGTERM: exit status {ended}; the good client: {dict(good.outcomes)}")
    wrong = set(good.outcomes) - {"right", "not served"}
    return 1 if bad or wrong or ended or not again else 0


if __name__ == "__main__":
    sys.exit(main())
