"""Calls of `pisigma serve --opcua` by many clients while the server is ended and restarted.

Run `python benchmarks/opcua.py models/my_ur10 --calls 10000 --clients 20`. Every client of asyncua calls
`CorrectedJoints` with poses of the model's training rows and joint values near them, and compares the answers with
those of Python. After a third of the calls the server gets SIGTERM, and after two thirds SIGKILL; it is restarted after
a second. A call without an answer is repeated until it is answered. The program prints the numbers of wrong answers, of
repeated calls and of clients that did not continue, and the times of the calls.
"""

import argparse
import asyncio
import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from asyncua import Client, ua
from serve import poses_of

import pisigma

PAUSE = 1.0
"""[s] Time between the end of a server and the start of the next."""
MAX_WAIT = 60.0
"""[s] Time without an answer after which a client counts as one that did not continue."""


def begin(model: Path, port: int) -> tuple["subprocess.Popen[str]", int]:
    """Start a server, and when it is ready return it and its port."""
    command = [sys.executable, "-m", "pisigma", "serve", str(model), "--opcua", "--opcua-port", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    return server, int(json.loads(server.stdout.readline())["opcua_port"])


class Load:
    """Clients that share the calls, with their counts."""

    def __init__(self, port: int, poses: np.ndarray, near: np.ndarray, expected: np.ndarray) -> None:
        self.port, self.poses, self.near, self.expected = port, poses, near, expected
        self.times: list[float] = []
        self.wrong = self.repeated = self.lost = 0

    async def ask(self, client: Client, index: int) -> None:
        """Make one call, and compare the answer with that of Python."""
        values = [
            ua.Variant(one[index].tolist(), ua.VariantType.Double, is_array=True)
            for one in (self.poses, self.near)
        ]
        owner, method = (client.get_node(f"ns=2;s=Model0{name}") for name in ("", ".CorrectedJoints"))
        q, reached, *_ = await owner.call_method(method, *values)
        self.wrong += (
            not reached
            or len(q) != len(self.expected[index])
            or not np.abs(q - self.expected[index]).max() < 1e-9
        )

    async def run(self, calls: int, number: int) -> None:
        """Make the calls of one client."""
        async with Client(
            f"opc.tcp://127.0.0.1:{self.port}", auto_reconnect=True, reconnect_max_delay=1.0
        ) as client:
            for call in range(calls):
                begun = time.perf_counter()
                while True:
                    try:
                        await self.ask(client, (call * 31 + number * 7) % len(self.poses))
                        break
                    except (ua.UaError, ConnectionError, TimeoutError):
                        self.repeated += 1
                        if time.perf_counter() - begun > MAX_WAIT:
                            self.lost += 1
                            return
                        await asyncio.sleep(0.1)
                self.times.append(time.perf_counter() - begun)


async def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Run all clients while the server is ended twice, and return the counts."""
    ik = pisigma.load(options.model)
    poses, near, expected = poses_of(ik)
    per_unit = np.where(ik.revolute, 180 / np.pi, 1e3)
    server, port = begin(options.model, 0)
    load = Load(port, poses, near * per_unit, expected * per_unit)
    clients = [
        asyncio.create_task(load.run(options.calls // options.clients, number))
        for number in range(options.clients)
    ]
    for share, ending in ((1 / 3, signal.SIGTERM), (2 / 3, signal.SIGKILL)):
        while len(load.times) < share * options.calls and not all(client.done() for client in clients):
            await asyncio.sleep(0.05)
        server.send_signal(ending)
        await asyncio.to_thread(server.wait)
        await asyncio.sleep(PAUSE)
        server, _ = await asyncio.to_thread(begin, options.model, port)
    await asyncio.gather(*clients)
    server.send_signal(signal.SIGTERM)
    server.wait()
    p50, p99 = np.quantile(load.times, [0.5, 0.99]) * 1e3
    return {
        "calls": len(load.times),
        "clients": options.clients,
        "wrong": load.wrong,
        "repeated": load.repeated,
        "clients_lost": load.lost,
        "p50_ms": round(p50, 3),
        "p99_ms": round(p99, 3),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", type=Path)
    parser.add_argument("--calls", type=int, default=10000)
    parser.add_argument("--clients", type=int, default=20)
    print(json.dumps(asyncio.run(measure(parser.parse_args()))))
