"""How long clients of `pisigma serve` wait: two of them, 1,000 requests a second in all, over loopback.

Run `OMP_NUM_THREADS=1 python benchmarks/serve.py models/my_ur10 --seconds 600` on a machine that does nothing else.
Every client sends a pose of the model's training rows with the joint values to be near to, waits for the answer,
compares it with that of Python, and sleeps until its next turn. Printed are the times from before a request is sent
until its answer is read, per protocol; how many answers were lost or wrong; and the memory of the server at the begin
and the end. For comparison the same clients ask a bare loop: a thread a connection around one solve.
"""

import argparse
import json
import multiprocessing
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

import pisigma

REQUEST, ANSWER = struct.Struct("<4sIQII16d8d"), struct.Struct("<4sIQII8d2d")
CLIENTS, RATE = 2, 1000.0
"""How many there are, and their requests a second in all."""
POSES = 1000


def poses_of(ik: pisigma.CorrectedIK) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses `(POSES, 6)` [mm, deg] at training rows, joint values near them, and those that Python gives [rad or m]."""
    from pisigma.kernels.array_kinematics import transform_of, xyzrpy_of

    starts = ik.model.starts.double().numpy()
    near = starts[np.random.default_rng(0).integers(len(starts), size=POSES)]
    units = np.array([1e3] * 3 + [180 / np.pi] * 3)
    poses = np.array([xyzrpy_of(T) for T in ik.forward(near)]) * units
    solutions = [ik(transform_of(pose / units), near=q).q for pose, q in zip(poses, near, strict=True)]
    return poses, near, np.array(solutions)


def messages(kind: str, ik: pisigma.CorrectedIK, poses: np.ndarray, near: np.ndarray) -> list[bytes]:
    """The requests, as a client would make them."""
    from pisigma.kernels.array_kinematics import transform_of

    units = np.array([1e3] * 3 + [180 / np.pi] * 3)
    if kind == "binary":
        beside = np.full((len(near), 8), np.nan)
        beside[:, : near.shape[1]] = near
        return [
            REQUEST.pack(b"PSI1", REQUEST.size, i, 0, 0, *transform_of(pose / units).ravel(), *q)
            for i, (pose, q) in enumerate(zip(poses, beside, strict=True))
        ]
    per_unit = np.where(ik.revolute, 180 / np.pi, 1e3)
    key = "near_deg" if ik.revolute.all() else "near"
    return [
        json.dumps({"id": i, "pose": pose.tolist(), key: (q * per_unit).tolist()}).encode() + b"\n"
        for i, (pose, q) in enumerate(zip(poses, near, strict=True))
    ]


def right(kind: str, answer: bytes, index: int, wanted: np.ndarray, per_unit: np.ndarray) -> bool:
    """Whether an answer is that of Python to the request that was sent."""
    if kind == "binary":
        _, _, name, _, dof, *q = ANSWER.unpack(answer)
        return bool(name == index and np.abs(np.array(q[:dof]) - wanted).max() < 1e-12)
    said = json.loads(answer)
    q = np.array(said["q_deg"] if "q_deg" in said else said["q"]) / per_unit
    return bool(said["id"] == index and np.abs(q - wanted).max() < 1e-9)


def ask(
    kind: str,
    port: int,
    sent: list[bytes],
    wanted: np.ndarray,
    per_unit: np.ndarray,
    seconds: float,
    queue: object,
) -> None:
    """One client; puts its times [µs] and how many answers were lost or wrong."""
    times, bad = [], 0
    with socket.create_connection(("127.0.0.1", port)) as stream, stream.makefile("rb") as file:
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        turn = time.perf_counter()
        end = turn + seconds
        for number in range(sys.maxsize):
            index = number % len(sent)
            begun = time.perf_counter()
            if begun > end:
                break
            stream.sendall(sent[index])
            answer = file.readline() if kind == "json" else file.read(ANSWER.size)
            times.append(1e6 * (time.perf_counter() - begun))
            bad += not right(kind, answer, index, wanted[index], per_unit)
            turn += CLIENTS / RATE
            time.sleep(max(0.0, turn - time.perf_counter()))
    queue.put((times, bad))  # type: ignore[attr-defined]


def measure(kind: str, port: int, model: str, seconds: float) -> str:
    """Have all clients ask, and say what they found."""
    ik = pisigma.load(model)
    poses, near, wanted = poses_of(ik)
    sent, per_unit = messages(kind, ik, poses, near), np.where(ik.revolute, 180 / np.pi, 1e3)
    queue = multiprocessing.Queue()
    arguments = (kind, port, sent, wanted, per_unit, seconds, queue)
    clients = [multiprocessing.Process(target=ask, args=arguments) for _ in range(CLIENTS)]
    for client in clients:
        client.start()
    results = [queue.get() for _ in clients]
    for client in clients:
        client.join()
    times = np.concatenate([times for times, _ in results])
    p50, p99, p999 = np.percentile(times, [50, 99, 99.9])
    bad = sum(bad for _, bad in results)
    return f"p50 {p50:.0f}, p99 {p99:.0f}, p99.9 {p999:.0f} µs of {len(times):,}; {bad} lost or wrong"


def bare_loop(model: str) -> int:
    """Serve frames by a thread a connection with one solve in it; gives the port."""
    ik, listener = pisigma.load(model), socket.create_server(("127.0.0.1", 0))

    def answer(stream: socket.socket) -> None:
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        dof = len(ik.joints)
        with stream.makefile("rb") as file:
            while len(message := file.read(REQUEST.size)) == REQUEST.size:
                T = np.frombuffer(message, "<f8", 16, 24).reshape(4, 4)
                solution = ik(T, near=np.frombuffer(message, "<f8", dof, 152), throw=False)
                name = int.from_bytes(message[8:16], "little")
                q = (*solution.q, *[0.0] * (8 - dof), solution.position_residual, solution.rotation_residual)
                stream.sendall(ANSWER.pack(b"PSI1", ANSWER.size, name, int(solution.status), dof, *q))

    def accept() -> None:
        while True:
            threading.Thread(target=answer, args=(listener.accept()[0],), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    return int(listener.getsockname()[1])


def serve_bare(model: str, queue: object) -> None:
    """The bare loop as a process of its own."""
    queue.put(bare_loop(model))  # type: ignore[attr-defined]
    threading.Event().wait()


def cost(pid: int) -> tuple[float, float]:
    """Memory of a process [MB] and the processor time that it has used [s]."""
    status = Path(f"/proc/{pid}/status").read_text()
    memory = next(int(line.split()[1]) / 1e3 for line in status.splitlines() if line.startswith("VmRSS"))
    used = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return memory, sum(map(int, used)) / 100


def main() -> None:
    """Measure every protocol, and the bare loop."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", default="models/kiro4")
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    command = [sys.executable, "-m", "pisigma", "serve", options.model]
    queue = multiprocessing.Queue()
    bare = multiprocessing.Process(target=serve_bare, args=(options.model, queue), daemon=True)
    bare.start()
    print(f"bare loop, binary: {measure('binary', queue.get(), options.model, options.seconds)}", flush=True)
    bare.terminate()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        ports = json.loads(server.stdout.readline())
        for kind in ("binary", "json"):
            before, used = cost(server.pid)
            said = measure(kind, ports[f"{kind}_port"], options.model, options.seconds)
            after, total = cost(server.pid)
            print(f"pisigma serve, {kind}: {said}; memory {before:.1f} -> {after:.1f} MB", flush=True)
            print(
                f"    {1e6 * (total - used) / (RATE * options.seconds):.0f} µs of the processor for a request"
            )
        server.terminate()


if __name__ == "__main__":
    main()
