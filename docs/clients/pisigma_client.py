"""Clients of `pisigma serve` that need only Python's standard library: for lines of JSON and for binary frames."""

import json
import math
import socket
import struct


class JsonClient:
    """Lines of JSON: `JsonClient(port).ask(pose=[800, 200, 600, 0, -90, 180])["q_deg"]`."""

    def __init__(self, port, host="127.0.0.1", token=None, timeout=5.0):
        self._socket = socket.create_connection((host, port), timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._lines = self._socket.makefile("rb")
        self._id = 0
        if token is not None:
            try:
                self._exchange({"token": token})
            except (ConnectionError, RuntimeError):
                self.close()
                raise

    def ask(self, **request):
        """Send a request and return the answer; raise RuntimeError if the server refuses it."""
        self._id += 1
        answer = self._exchange({"id": self._id, **request})
        if answer["id"] != self._id:
            raise ConnectionError(f"expected the answer to request {self._id}, got that to {answer['id']}")
        return answer

    def _exchange(self, request):
        self._socket.sendall(json.dumps(request).encode() + b"\n")
        line = self._lines.readline()
        if not line.endswith(b"\n"):
            raise ConnectionError("the server has closed the connection")
        answer = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer

    def close(self):
        """Close the connection."""
        self._lines.close()
        self._socket.close()


REQUEST, ANSWER = struct.Struct("<4sIQII16d8d"), struct.Struct("<4sIQII8d2d8s")


class FrameClient:
    """Binary frames: `status, q, residuals = FrameClient(port).solve(T)`; metres and radians.

    `sha256` has the first 16 digits of the SHA-256 of the model that answered last.
    """

    def __init__(self, port, host="127.0.0.1", token=None, timeout=5.0):
        self._socket = socket.create_connection((host, port), timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._id, self.sha256 = 0, ""
        if token is not None:
            secret = token.encode()
            self._socket.sendall(struct.pack("<4sIQII", b"PSI1", 24 + len(secret), 0, 0, 1) + secret)
            if self._receive()[3] != 0:
                self.close()
                raise ConnectionError("the token is not the right one")

    def solve(self, T_base_tool, near=None, model=0):
        """Joint values for the 16 numbers of a pose, row by row.

        Gives the status, the joint values (NaN where the status says that there are none), and the residuals of
        position and rotation.
        """
        self._id += 1
        near = () if near is None else near
        near_values = [*near, *[math.nan] * (8 - len(near))]
        self._socket.sendall(
            REQUEST.pack(b"PSI1", REQUEST.size, self._id, model, 0, *T_base_tool, *near_values)
        )
        _, _, answered, status, joints, *values, model = self._receive()
        if answered != self._id:
            raise ConnectionError(f"an answer to request {answered} came, not to {self._id}")
        self.sha256 = model.hex()
        return status, values[:joints], values[8:]

    def _receive(self):
        received = b""
        while len(received) < ANSWER.size:
            more = self._socket.recv(ANSWER.size - len(received))
            if not more:
                raise ConnectionError("the server has closed the connection")
            received += more
        return ANSWER.unpack(received)

    def close(self):
        """Close the connection."""
        self._socket.close()
