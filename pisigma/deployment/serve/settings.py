"""Settings of a server."""

import ipaddress
import math
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pisigma.deployment.serve.polling import POLL_DURATION
from pisigma.files.errors import OutputError
from pisigma.files.input_file import read_input
from pisigma.files.setting import HIDDEN, Option

_LAST_PORT = 65535
_CLIENT_TIMEOUT = 10.0
"""Longest time for the remainder of a message, a token, or the reception of an answer, before a client is
disconnected [s]."""


def read_token(file: Path) -> str:
    """Read the token from a file."""
    return read_input(file, OutputError).decode(errors="replace").strip()


def is_local(host: str) -> bool:
    """Return whether only programs on this machine can reach an address.

    Raises:
        OutputError: it is not an address of this machine.
    """
    try:
        found = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)
    except OSError as problem:
        raise OutputError(
            f"'{host}' is not an address of this machine ({problem.strerror})",
            option="--host",
            value=host,
            remedy="give 127.0.0.1, or 0.0.0.0 for all addresses",
        ) from None
    return all(ipaddress.ip_address(str(entry[4][0])).is_loopback for entry in found)


@dataclass(frozen=True)
class ServeSettings:
    """Settings of a server.

    Attributes:
        host: address to listen on. Addresses other than those of this machine need a token.
        json_port: port for lines of JSON (0: any free port).
        binary_port: port for binary frames (0: any free port).
        zmq_port: port for ZeroMQ (0: any free port). Requires the extra serve. None: no ZeroMQ.
        opcua: also serve over OPC UA. Requires the extra opcua.
        opcua_port: port for OPC UA (0: any free port).
        opcua_certificates: folder of the certificate for OPC UA, which is created if it is missing, and of the
            certificates of clients in the subfolder `trusted`. Required if other machines can reach the server.
        token: token that every client has to send first; on a command line, a file that contains the token.
        client_timeout: longest time for the remainder of a message, a token, or the reception of an answer [s].
        rsi: file written by `pisigma export --format rsi`, to serve only a KUKA controller over RSI.
        rsi_max_correction: largest correction of a joint over RSI [rad]; a larger correction ends the stream.
        polling: time to busy-poll for the next request [s] (0: sleep at once). The server polls only if requests
            arrive at least that often and no other program needs the processor.
    """

    host: str = "127.0.0.1"
    json_port: Annotated[int, Option("--port", min=0, max=_LAST_PORT)] = 0
    binary_port: Annotated[int, Option(min=0, max=_LAST_PORT)] = 0
    zmq_port: Annotated[int | None, Option(min=0, max=_LAST_PORT)] = None
    opcua: bool = False
    opcua_port: Annotated[int, Option(min=0, max=_LAST_PORT)] = 4840
    opcua_certificates: Path | None = None
    token: Annotated[str | None, Option("--token-file", kind=Path, read=read_token)] = None
    client_timeout: Annotated[float, HIDDEN] = _CLIENT_TIMEOUT
    rsi: Path | None = None
    rsi_max_correction: Annotated[
        float, Option("--rsi-max-correction-deg", unit="deg", min=0, max=5, is_key_only=True)
    ] = math.radians(1.0)
    polling: Annotated[float, Option("--poll-ms", unit="ms", min=0, max=100, is_key_only=True)] = (
        POLL_DURATION
    )
