"""Joint corrections over RSI, driven by the echo server of RSIPI, which emulates a KUKA controller.

`pisigma export MODEL --format rsi --out rsi.xml`, then set IP_NUMBER in rsi.xml to 127.0.0.1
`pisigma serve MODEL --rsi rsi.xml`
`python benchmarks/rsi.py rsi.xml 10000` (in an environment with `pip install rsipi`; it does not import pisigma)

The echo server reads the configuration, makes the packets, and accepts an answer only with the right sender and time
stamp within the cycle. In this benchmark, it moves along a path of the joints, adds accepted corrections to the
setpoint that it sends, and sends a packet in every cycle. The output is one JSON object with counts and times; `--rows`
adds the setpoints of the program and the received corrections. An answer is late if its cycle is over, and wrong if the
echo server rejects it for another reason.
"""

import argparse
import contextlib
import json
import logging
import math
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

START = (20.0, -80.0, 90.0, 10.0, 60.0, 15.0)
"""[deg] Joint values at the start."""
AMPLITUDE, PERIOD_S = 15.0, 6.0
"""[deg, s] Amplitude and period of the sine by which every joint swings, at up to 16 deg/s."""


def measure(configuration: Path, cycles: int, cycle_ms: int) -> dict[str, Any]:
    """Run a number of cycles, and return counts, times [ms] and rows."""
    os.chdir(tempfile.mkdtemp())  # the server writes a folder of logs
    from RSIPI import rsi_echo_server as rsipi

    logging.disable()
    rsipi.CORRECTION_TO_STATE["AKorr"] = "ASPos"
    controller = rsipi.EchoServer(str(configuration), cycle_ms, "absolute", timeout_packets=cycles)
    times, setpoints, corrections, outcomes = [], [], [], []
    judge = controller.process_reply

    def judged(reply: str) -> bool | None:
        outcomes.append(judge(reply))
        return outcomes[-1]

    controller.process_reply = judged
    following = time.perf_counter()
    for number in range(cycles):
        swing = AMPLITUDE * math.sin(2 * math.pi * number * cycle_ms / 1e3 / PERIOD_S)
        last = controller.last_corrections.get("AKorr", {})
        programmed = {f"A{i}": value + swing for i, value in enumerate(START, 1)}
        controller.base_pose["ASPos"] = programmed
        controller.state["ASPos"] = {name: value + last.get(name, 0) for name, value in programmed.items()}
        began = time.perf_counter()
        controller.send_once()
        if controller.receive_and_process():
            times.append((time.perf_counter() - began) * 1e3)
            setpoints.append(list(programmed.values()))
            corrections.append(list(controller.last_corrections["AKorr"].values()))
        following = max(following + cycle_ms / 1e3, time.perf_counter() - cycle_ms / 1e3)
        time.sleep(max(0.0, following - time.perf_counter()))
    controller.udp_socket.close()
    ordered = sorted(times) or [math.nan]
    return {
        "cycles": cycles,
        "late": cycles - len(times),
        "wrong": outcomes.count(False),
        **{f"p{share}_ms": ordered[(len(ordered) - 1) * share // 100] for share in (50, 99, 100)},
        "rows": {"setpoints_deg": setpoints, "corrections_deg": corrections},
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("configuration", type=Path)
    parser.add_argument("cycles", type=int, nargs="?", default=10_000)
    parser.add_argument("--cycle-ms", type=int, choices=(4, 12), default=4)
    parser.add_argument("--rows", action="store_true")
    stated = parser.parse_args()
    with contextlib.redirect_stdout(sys.stderr):
        measured = measure(stated.configuration.resolve(), stated.cycles, stated.cycle_ms)
    if not stated.rows:
        del measured["rows"]
    print(json.dumps(measured))
