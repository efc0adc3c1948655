"""`pisigma serve`: answer requests of other programs for corrected joint values."""

import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import complete_model
from pisigma.cli.output import print_json, print_line

if TYPE_CHECKING:
    from pisigma.deployment.serve.models import ServedModels

Model = Annotated[Path | None, typer.Argument(help="Model folder.", autocompletion=complete_model)]
Models = Annotated[
    Path | None, typer.Option("--models", help="Folder of model folders, which are all served, by name.")
]
Host = Annotated[
    str, typer.Option(help="Address to listen at; other than that of this machine only with --token-file.")
]
Port = Annotated[
    int, typer.Option("--port", min=0, max=65535, help="Port for lines of JSON; 0 for a free one.")
]
BinaryPort = Annotated[int, typer.Option(min=0, max=65535, help="Port for binary frames; 0 for a free one.")]
ZmqPort = Annotated[
    int | None,
    typer.Option(
        min=0, max=65535, help="Port for ZeroMQ too; 0 for a free one. Needs the extra serve. [default: none]"
    ),
]
TokenFile = Annotated[
    Path | None, typer.Option(help="File with the token that every client has to send first.")
]
PollMs = Annotated[
    float,
    typer.Option(
        min=0,
        max=100,
        help="Milliseconds to stay awake for the next request, where requests come that often and no other program "
        "wants the processor; 0 to sleep at once.",
    ),
]


def serve(
    model: Model = None,
    models: Models = None,
    host: Host = "127.0.0.1",
    port: Port = 0,
    binary_port: BinaryPort = 0,
    zmq_port: ZmqPort = None,
    token_file: TokenFile = None,
    poll_ms: PollMs = 2.5,
) -> None:
    """Answer requests for corrected joint values, paths and poses, until SIGTERM or Ctrl-C.

    When it is ready, it prints one JSON line with its ports. SIGHUP loads models again whose folders have changed.
    """
    from pisigma.deployment.serve.server import Server, ServeSettings
    from pisigma.files.errors import OutputError
    from pisigma.files.input_file import read_input

    token = (
        None if token_file is None else read_input(token_file, OutputError).decode(errors="replace").strip()
    )
    served = _load(model, models)
    server = Server(served, ServeSettings(host, port, binary_port, zmq_port, token, polling=poll_ms / 1e3))
    for problem in served.problems:
        print_line(problem, to_stderr=True)
    for name in (signal.SIGTERM, signal.SIGINT):
        signal.signal(name, lambda *_: server.stop())
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, lambda *_: server.reload(lambda line: print_line(line, to_stderr=True)))
    print_json(server.ports)
    server.run()


def _load(model: Path | None, models: Path | None) -> "ServedModels":
    """Load the model, or those of a folder."""
    from pisigma.deployment.serve.models import ServedModels, model_folders

    if model is not None and models is None:
        return ServedModels([model])
    if models is None or model is not None:
        raise typer.BadParameter("give either a model folder or --models", param_hint="'MODEL' / '--models'")
    return ServedModels(model_folders(models), within=models)
