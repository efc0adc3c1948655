"""Subsets of controllers' languages, for running or parsing the clients in the documentation."""

import math
import re
import socket
from collections.abc import Callable, Sequence

import numpy as np

_WORD = r"[A-Za-z_$][\w.$]*"
_TEXT = r"(?:\"(?:[^\"]|\"\")*\"|'[^']*')"
_EXPRESSION = rf"(?:{_TEXT}|[\w $.#%+\-*/<>=(),\[\]{{}}:\\])+"

_STRUCTURED_TEXT = (
    r"\(\*[\s\S]*?\*\)|\{attribute 'pack_mode' := '1'\}",
    (
        (rf"TYPE {_WORD} :", "END_TYPE"),
        ("STRUCT", "END_STRUCT"),
        (rf"FUNCTION_BLOCK {_WORD}", "END_FUNCTION_BLOCK"),
        ("VAR(_INPUT|_OUTPUT)?", "END_VAR"),
        (rf"IF {_EXPRESSION} THEN", "END_IF;"),
        (rf"CASE {_WORD} OF", "END_CASE;"),
    ),
    (
        rf"{_WORD} : (ARRAY\[\d+\.\.\d+\] OF )?{_WORD}(\(\d+\))?( := {_EXPRESSION})?;",
        rf"{_WORD}(\[\w+\](\.{_WORD})?)* := {_EXPRESSION};",
        rf"{_WORD}\({_EXPRESSION}\);",
        r"\d+:",
    ),
)

LANGUAGES: dict[str, tuple[str, Sequence[tuple[str, str]], Sequence[str]]] = {
    "pisigma_client.src": (
        r";.*",
        (
            (rf"(GLOBAL )?DEF {_WORD}\(.*\)", "END"),
            (rf"FOR {_WORD} = {_EXPRESSION} TO {_EXPRESSION}", "ENDFOR"),
            (rf"IF {_EXPRESSION} THEN", "ENDIF"),
        ),
        (
            rf"DECL {_WORD} {_WORD}(\[\d+\])?(, {_WORD}(\[\d+\])?)*",
            rf"WAIT FOR {_EXPRESSION}",
            rf"{_WORD}(\[\w+\])? = {_EXPRESSION}",
            rf"{_WORD}\({_EXPRESSION}\)",
        ),
    ),
    "pisigma_client.mod": (
        r"!.*",
        (
            (rf"MODULE {_WORD}", "ENDMODULE"),
            (rf"PROC {_WORD}\(.*\)", "ENDPROC"),
            (rf"FUNC {_WORD} {_WORD}\(.*\)", "ENDFUNC"),
            (rf"IF {_EXPRESSION} THEN", "ENDIF"),
            (rf"WHILE {_EXPRESSION} DO", "ENDWHILE"),
        ),
        (
            rf"VAR {_WORD} {_WORD}(\{{\d\}})?( := {_EXPRESSION})?;",
            rf"ELSEIF {_EXPRESSION} THEN",
            rf"RETURN {_EXPRESSION};",
            rf"{_WORD} := {_EXPRESSION};",
            rf"{_WORD} {_EXPRESSION};",
        ),
    ),
    "pisigma_client.kl": (
        r"--.*|%NOLOCKGROUP",
        (
            (rf"PROGRAM {_WORD}", rf"END {_WORD}"),
            (rf"FOR {_WORD} = {_EXPRESSION} TO {_EXPRESSION} DO", "ENDFOR"),
            (rf"WHILE {_EXPRESSION} DO", "ENDWHILE"),
            (rf"IF {_EXPRESSION} THEN", "ENDIF"),
        ),
        (
            "VAR|BEGIN",
            rf"{_WORD}(, {_WORD})* : (ARRAY\[\d\] OF )?{_WORD}(\[\d+\])?",
            rf"(OPEN|CLOSE) FILE {_WORD}( \({_EXPRESSION}\))?",
            rf"(READ|WRITE) {_WORD} \({_EXPRESSION}\)",
            rf"{_WORD} = {_EXPRESSION}",
            rf"{_WORD}\({_EXPRESSION}\)",
        ),
    ),
    "pisigma_client.st": _STRUCTURED_TEXT,
    "pisigma_opcua.st": _STRUCTURED_TEXT,
}
"""For each file: pattern of remarks, blocks with their ends, and other statements, one per line."""


def parse(name: str, text: str) -> int:
    """Parse a program line by line, and return its number of statements; ValueError names an invalid line."""
    remark, blocks, statements = LANGUAGES[name]
    open_blocks: list[str] = []
    count = 0
    for number, line in enumerate(re.sub(remark, "", text).splitlines(), 1):
        words = line.strip()
        end = next((end for begin, end in blocks if re.fullmatch(begin, words)), None)
        if not words:
            continue
        count += 1
        if open_blocks and re.fullmatch(open_blocks[-1], words):
            open_blocks.pop()
        elif end is not None:
            open_blocks.append(end)
        elif not any(re.fullmatch(statement, words) for statement in statements):
            raise ValueError(f"{name}, line {number}: {words}")
    if open_blocks:
        raise ValueError(f"{name}: {open_blocks[-1]} is missing")
    return count


def run_urscript(text: str, q_now: Sequence[float]) -> dict[str, Callable[..., object]]:
    """Return the functions of a URScript program as Python functions, which use real sockets.

    URScript is like Python, except for `end` and the scope of variables.

    Args:
        text: text of the program.
        q_now: current joint values of the robot [rad].
    """
    lines = []
    for line in text.splitlines():
        code = line.partition("#")[0].rstrip()
        lines.append(re.sub(r"^(\s*)(local|global) ", r"\1", "" if code.strip() == "end" else code))
    sockets: dict[str, socket.socket] = {}

    def socket_open(host: str, port: int, name: str) -> bool:
        sockets[name] = socket.create_connection((host, port), 5)
        return True

    def read_line(name: str, timeout: float) -> str:
        sockets[name].settimeout(timeout)
        received = b""
        while not received.endswith(b"\n"):
            received += sockets[name].recv(1)
        return received.decode().rstrip("\n")

    def floor(value: float) -> int:
        assert abs(value) < 2**31, "URScript has integers of 32 bits"
        return math.floor(value)

    def as_text(value: float) -> str:
        return str(value) if isinstance(value, int) else f"{value:.6g}"

    known: dict[str, Callable[..., object]] = {
        "socket_open": socket_open,
        "socket_close": lambda name: sockets[name].close(),
        "socket_send_string": lambda words, name: sockets[name].sendall(words.encode()),
        "socket_send_line": lambda words, name: sockets[name].sendall(words.encode() + b"\n"),
        "socket_send_byte": lambda byte, name: sockets[name].sendall(bytes([byte])),
        "socket_read_line": read_line,
        "str_cat": lambda first, second: first + second,
        "str_find": lambda words, wanted, start=0: words.find(wanted, start),
        "str_sub": lambda words, start, length: words[start : start + length],
        "to_num": float,
        "to_str": as_text,
        "floor": floor,
        "d2r": math.radians,
        "r2d": math.degrees,
        "rotvec2rpy": _roll_pitch_yaw,
        "get_actual_joint_positions": lambda: list(q_now),
    }
    exec("\n".join(lines), known)
    return known


def _roll_pitch_yaw(vector: Sequence[float]) -> list[float]:
    """Return the angles about x, y and z of a rotation vector, for RotZ · RotY · RotX."""
    angle = float(np.linalg.norm(vector))
    x, y, z = np.array(vector) / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    R = np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K
    return [
        math.atan2(R[2, 1], R[2, 2]),
        math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0])),
        math.atan2(R[1, 0], R[0, 0]),
    ]
