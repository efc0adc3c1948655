"""Servers for tests, and the clients of the documentation."""

import importlib.util
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from testing.models import REPOSITORY, no_type_checker

from pisigma.deployment.serve.models import ServedModels
from pisigma.deployment.serve.server import Server
from pisigma.deployment.serve.settings import ServeSettings

CLIENTS = REPOSITORY / "docs" / "clients"


def _client_module():
    spec = importlib.util.spec_from_file_location("pisigma_client", CLIENTS / "pisigma_client.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


client = _client_module()


@contextmanager
def running(*folders: Path, settings: ServeSettings | None = None, **options) -> Iterator[Server]:
    """Run a server in a thread, which is stopped at the end and has to end then."""
    with no_type_checker():
        server = Server(ServedModels(folders, **options), settings or ServeSettings())
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.stop()
        thread.join(10)
        assert not thread.is_alive()


@contextmanager
def json_client(server: Server, **options) -> Iterator[client.JsonClient]:
    """Return the client for lines of JSON."""
    connected = client.JsonClient(server.json_port, **options)
    try:
        yield connected
    finally:
        connected.close()


@contextmanager
def frame_client(server: Server, **options) -> Iterator[client.FrameClient]:
    """Return the client for binary frames."""
    connected = client.FrameClient(server.binary_port, **options)
    try:
        yield connected
    finally:
        connected.close()
