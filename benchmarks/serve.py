"""Response times of `pisigma serve`: two clients with 1,000 requests per second in total, over loopback.

Run `OMP_NUM_THREADS=1 python benchmarks/serve.py models/my_ur10 --seconds 600` on an otherwise idle machine. Every
client sends a pose of the model's training rows with joint values near it, waits for the answer, compares it with that
of Python, and sleeps until its next request, half a period after that of the other client. A client polls for 100 µs,
as the loop of a real-time controller does, and then sleeps; with `--awake-us 0` the system wakes it for every answer,
and the times then include the wake-up, which takes longer than the answer itself on some machines. For each protocol
the program prints the times from before a request is sent until its answer is read, the number of answers that were
lost or wrong, and the memory of the server at the start and at the end. For comparison, the same clients first use two
minimal loops, for at most a minute each, which poll for the next request as long as the server does: one of them sends
stored answers, and the other one reads, solves once and sends. The first loop shows the cost of sockets and clients,
and the second one the cost that the server adds to a solve.
"""

import argparse
import functools
import itertools
import json
import math
import multiprocessing
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import pisigma

REQUEST, ANSWER = struct.Struct("<4sIQII16d8d"), struct.Struct("<4sIQII8d2d8s")
CLIENTS, RATE = 2, 1000.0
"""Number of clients, and their requests per second in total."""
POSES = 1000
BARE_SECONDS, IDLE_SECONDS = 60.0, 5.0
UNITS = np.array([1e3] * 3 + [180 / np.pi] * 3)
"""Units of poses in files per metre and per radian."""


def poses_of(ik: pisigma.CorrectedIK) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return poses `(POSES, 6)` [mm, deg] of training rows, joint values near them, and Python's answers [rad or m]."""
    from pisigma.robot.kernels.array_kinematics import transform_of, xyz_zyx_of

    starts = ik.model.starts.double().numpy()
    near = starts[np.random.default_rng(0).integers(len(starts), size=POSES)]
    poses = np.array([xyz_zyx_of(T) for T in ik.forward(near)]) * UNITS
    solutions = [ik(transform_of(pose / UNITS), near=q).q for pose, q in zip(poses, near, strict=True)]
    return poses, near, np.array(solutions)


def messages(kind: str, ik: pisigma.CorrectedIK, poses: np.ndarray, near: np.ndarray) -> list[bytes]:
    """Return the requests of a client."""
    from pisigma.robot.kernels.array_kinematics import transform_of

    if kind == "binary":
        padded = np.full((len(near), 8), np.nan)
        padded[:, : near.shape[1]] = near
        return [
            REQUEST.pack(b"PSI1", REQUEST.size, i, 0, 0, *transform_of(pose / UNITS).ravel(), *q)
            for i, (pose, q) in enumerate(zip(poses, padded, strict=True))
        ]
    per_unit = np.where(ik.revolute, 180 / np.pi, 1e3)
    key = "near_deg" if ik.revolute.all() else "near"
    return [
        json.dumps({"id": i, "pose": pose.tolist(), key: (q * per_unit).tolist()}).encode() + b"\n"
        for i, (pose, q) in enumerate(zip(poses, near, strict=True))
    ]


def right(kind: str, answer: bytes, index: int, wanted: np.ndarray, per_unit: np.ndarray) -> bool:
    """Return whether an answer agrees with Python's answer."""
    if kind == "binary":
        _, _, name, _, dof, *q = ANSWER.unpack(answer)
        return bool(name == index and np.abs(np.array(q[:dof]) - wanted).max() < 1e-12)
    said = json.loads(answer)
    q = np.array(said["q_deg"] if "q_deg" in said else said["q"]) / per_unit
    return bool(said["id"] == index and np.abs(q - wanted).max() < 1e-9)


def received(stream: socket.socket, kind: str, awake: float) -> bytes:
    """Return the next complete answer; poll for some time, then sleep."""
    answer, end = b"", time.perf_counter() + awake
    while not (answer.endswith(b"\n") if kind == "json" else len(answer) == ANSWER.size):
        try:
            chunk = stream.recv(65536, socket.MSG_DONTWAIT if time.perf_counter() < end else 0)
        except BlockingIOError:
            continue
        if not chunk:
            raise ConnectionError("the server closed the connection")
        answer += chunk
    return answer


def ask(
    kind: str,
    port: int,
    sent: list[bytes],
    wanted: np.ndarray,
    per_unit: np.ndarray,
    options: argparse.Namespace,
    seconds: float,
    number: int,
    queue: "multiprocessing.Queue[Any]",
) -> None:
    """Run client `number`; put its times [µs] and the number of lost or wrong answers into the queue."""
    times, bad = [], 0
    with socket.create_connection(("127.0.0.1", port)) as stream:
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        period = CLIENTS / RATE
        turn = (math.ceil(time.perf_counter() / period) + number / CLIENTS) * period
        end = turn + seconds
        for index in itertools.cycle(range(len(sent))):
            time.sleep(max(0.0, turn - time.perf_counter()))
            begun = time.perf_counter()
            if begun > end:
                break
            stream.sendall(sent[index])
            answer = received(stream, kind, options.awake_us * 1e-6)
            times.append(1e6 * (time.perf_counter() - begun))
            bad += not right(kind, answer, index, wanted[index], per_unit)
            turn += period
    queue.put((times, bad))


def measure(kind: str, port: int, options: argparse.Namespace, seconds: float) -> tuple[np.ndarray, str]:
    """Run all clients; return the median and 99 % quantile of their times [µs], and a sentence."""
    ik = pisigma.load(options.model)
    poses, near, wanted = poses_of(ik)
    sent, per_unit = messages(kind, ik, poses, near), np.where(ik.revolute, 180 / np.pi, 1e3)
    queue: multiprocessing.Queue[Any] = multiprocessing.Queue()
    arguments = kind, port, sent, wanted, per_unit, options, seconds
    clients = [multiprocessing.Process(target=ask, args=(*arguments, i, queue)) for i in range(CLIENTS)]
    for client in clients:
        client.start()
    results = [queue.get() for _ in clients]
    for client in clients:
        client.join()
    times = np.concatenate([times for times, _ in results])
    p50, p99, p999 = np.percentile(times, [50, 99, 99.9])
    bad = sum(bad for _, bad in results)
    words = f"p50 {p50:.0f}, p99 {p99:.0f}, p99.9 {p999:.0f} µs of {len(times):,}; {bad} lost or wrong"
    return np.array([p50, p99]), words


def answer_frame(ik: pisigma.CorrectedIK, message: bytes) -> bytes:
    """Solve one binary frame."""
    _, _, name, _, _, *numbers = REQUEST.unpack(message)
    dof = len(ik.joints)
    solution = ik(np.array(numbers[:16]).reshape(4, 4), near=np.array(numbers[16 : 16 + dof]), throw=False)
    q = (*solution.q, *[0.0] * (8 - dof), solution.position_residual, solution.rotation_residual)
    return ANSWER.pack(b"PSI1", ANSWER.size, name, int(solution.status), dof, *q, b"")


def answer_line(ik: pisigma.CorrectedIK, message: bytes) -> bytes:
    """Solve one line of JSON."""
    from pisigma.robot.kernels.array_kinematics import transform_of

    request, per_unit = json.loads(message), np.where(ik.revolute, 180 / np.pi, 1e3)
    T = transform_of(np.array(request["pose"]) / UNITS)
    near = request["near_deg"] if "near_deg" in request else request["near"]
    solution = ik(T, near=np.array(near) / per_unit, throw=False)
    key = "q_deg" if "near_deg" in request else "q"
    said = {"id": request["id"], key: (solution.q * per_unit).tolist(), "status": int(solution.status)}
    return json.dumps(said).encode() + b"\n"


def bare_loop(
    model: str, kind: str, stored: bool, polling: float, queue: "multiprocessing.Queue[int]"
) -> None:
    """Answer all clients with a solution or a stored answer, without any check; put the port into the queue."""
    ik = pisigma.load(model)
    answer: Callable[[bytes], bytes] = functools.partial(
        answer_frame if kind == "binary" else answer_line, ik
    )
    if stored:
        poses, near, _ = poses_of(ik)
        answer = {message: answer(message) for message in messages(kind, ik, poses, near)}.__getitem__
    listener, waiting, last = socket.create_server(("127.0.0.1", 0)), select.epoll(), 0.0
    queue.put(listener.getsockname()[1])
    streams = {stream.fileno(): stream for stream, _ in (listener.accept() for _ in range(CLIENTS))}
    for number, stream in streams.items():
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        waiting.register(number, select.EPOLLIN)
    while streams:
        ready = waiting.poll(0 if time.monotonic() - last < polling else None)
        for number, _ in ready:
            if message := streams[number].recv(4096):
                streams[number].sendall(answer(message))
                last = time.monotonic()
            else:
                waiting.unregister(number)
                streams.pop(number).close()


def cost(pid: int) -> tuple[float, float]:
    """Return the memory of a process [MB] and the processor time that it has used [s]."""
    status = Path(f"/proc/{pid}/status").read_text()
    memory = next(int(line.split()[1]) / 1e3 for line in status.splitlines() if line.startswith("VmRSS"))
    used = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return memory, sum(map(int, used)) / 100


def inside(json_port: int) -> str:
    """Return the time from reading a request until the answer is ready, for the last answers of the server."""
    with socket.create_connection(("127.0.0.1", json_port)) as stream, stream.makefile("rb") as file:
        stream.sendall(b'{"ask": "health"}\n')
        health = json.loads(file.readline())
    return f"p50 {health['p50_us']:.0f}, p99 {health['p99_us']:.0f} µs"


def compare(kind: str, ports: dict[str, int], pid: int, options: argparse.Namespace) -> None:
    """Measure a protocol of the server, after the minimal loops."""
    for name, stored in (("stored answers", True), ("one solve", False)):
        queue: multiprocessing.Queue[int] = multiprocessing.Queue()
        arguments = options.model, kind, stored, options.poll_ms / 1e3, queue
        bare = multiprocessing.Process(target=bare_loop, args=arguments, daemon=True)
        bare.start()
        least, said = measure(kind, queue.get(), options, min(options.seconds, BARE_SECONDS))
        bare.join()
        print(f"minimal loop, {name}, {kind}: {said}", flush=True)
    before, used = cost(pid)
    times, said = measure(kind, ports[f"{kind}_port"], options, options.seconds)
    after, total = cost(pid)
    (p50, p99), share = times / least, (total - used) / options.seconds
    print(f"pisigma serve, {kind}: {said}; memory {before:.1f} -> {after:.1f} MB")
    print(f"    inside the server {inside(ports['json_port'])}")
    print(
        f"    {p50:.2f} and {p99:.2f} times the bare loop with a solve; {share:.0%} of a processor",
        flush=True,
    )


def main() -> None:
    """Measure every protocol."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", default="models/kiro4")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument(
        "--poll-ms", type=float, default=2.5, help="Polling time of the server and the minimal loops [ms]."
    )
    parser.add_argument("--awake-us", type=float, default=100.0, help="Polling time of the clients [us].")
    options = parser.parse_args()
    command = [sys.executable, "-m", "pisigma", "serve", options.model, "--set", f"poll_ms={options.poll_ms}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        ports = json.loads(server.stdout.readline())
        for kind in ("binary", "json"):
            compare(kind, ports, server.pid, options)
        _, before = cost(server.pid)
        time.sleep(IDLE_SECONDS)
        print(f"idle: {(cost(server.pid)[1] - before) / IDLE_SECONDS:.1%} of a processor")
        server.terminate()


if __name__ == "__main__":
    main()
