"""`pisigma serve`: answer requests of other programs for corrected joint values."""

import math
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import complete_model
from pisigma.cli.output import print_json, print_line
from pisigma.cli.settings_options import takes_settings
from pisigma.deployment.serve.settings import ServeSettings
from pisigma.files.errors import OutputError
from pisigma.files.setting import flat_settings

if TYPE_CHECKING:
    from pisigma.deployment.serve.models import ServedModels

Model = Annotated[
    Path | None,
    typer.Argument(metavar="[MODEL|CELL]", help="Model folder or cell.", autocompletion=complete_model),
]
Pin = Annotated[
    bool,
    typer.Option(
        "--pin", help="Keep serving the model in use at the start, even if another is put into use."
    ),
]
Models = Annotated[Path | None, typer.Option("--models", help="Folder of model folders to serve by name.")]


@takes_settings
def serve(
    settings: ServeSettings,
    model: Model = None,
    models: Models = None,
    pin: Pin = False,
) -> None:
    """Answer requests for corrected joint values, paths and poses, until SIGTERM or Ctrl-C.

    Prints one JSON line with its ports when it is ready. SIGHUP reloads models whose folders have changed. If a cell's
    model in use changes, later requests are answered with the new one. With --rsi, the model at the start corrects the
    joints of a KUKA controller in every cycle, also after SIGHUP; a fault ends the stream with status 2.
    """
    from pisigma.deployment.serve.server import Server

    if settings.rsi is not None:
        _check_rsi_alone(settings, models, pin)
        _stream(settings, settings.rsi, model)
        return

    def report(line: str) -> None:
        print_line(line, to_stderr=True)

    served = _load(model, models, pin)
    server = Server(served, settings)
    for sentence in (*served.problems, *served.warnings):
        report(sentence)
    for name in (signal.SIGTERM, signal.SIGINT):
        signal.signal(name, lambda *_: server.stop())
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, lambda *_: server.reload(report))
    print_json(server.ports)
    with served.follow_changes(report):
        server.run()


def _load(model: Path | None, models: Path | None, pin: bool) -> "ServedModels":
    """Load a model, the model in use of a cell, or all models of a folder."""
    from pisigma.deployment.serve.models import ServedModels, model_folders
    from pisigma.lifetime.cell.controller import checked_model_folder
    from pisigma.lifetime.cell.layout import is_cell

    if pin and (model is None or not is_cell(model)):
        raise typer.BadParameter("expected a cell", param_hint="'--pin'")
    if model is not None and models is None:
        if is_cell(model) and not pin:
            return ServedModels(cell=model)
        folder, warnings = checked_model_folder(model, "serve")
        served = ServedModels([folder])
        served.problems.extend(warnings)
        return served
    if models is None or model is not None:
        raise typer.BadParameter(
            "expected either a model folder or --models", param_hint="'MODEL' / '--models'"
        )
    return ServedModels(model_folders(models), within=models)


_ALSO_OF_RSI = ("rsi", "rsi_max_correction")
"""Settings that a stream over RSI uses."""


def _check_rsi_alone(settings: ServeSettings, models: Path | None, pin: bool) -> None:
    """Refuse options of other protocols, which a stream over RSI would not use.

    Raises:
        OutputError: such an option is given.
    """
    usual = ServeSettings()
    stated = [
        one.spelling
        for one in flat_settings(ServeSettings)
        if one.field not in _ALSO_OF_RSI and getattr(settings, one.field) != getattr(usual, one.field)
    ]
    stated += [name for name, value in (("--models", models), ("--pin", pin)) if value]
    if stated:
        raise OutputError(
            "expected no options of other protocols",
            value=", ".join(stated),
            option="--rsi",
            remedy="serve other protocols in a second process",
        )


def _stream(settings: ServeSettings, file: Path, model: Path | None) -> None:
    """Correct the joints of a KUKA controller over RSI."""
    from pisigma.deployment.export.rsi import RsiAddress
    from pisigma.deployment.serve.rsi import RsiServer
    from pisigma.lifetime.cell.controller import checked_model_folder
    from pisigma.model.inverse.loading import load

    if model is None:
        raise typer.BadParameter("expected a model folder or a cell", param_hint="'MODEL'")
    folder, warnings = checked_model_folder(model, "serve")
    ik = load(folder)
    for warning in (*warnings, *ik.warnings):
        print_line(warning, to_stderr=True)
    server = RsiServer(ik, RsiAddress.read(file), math.degrees(settings.rsi_max_correction))
    for name in (signal.SIGTERM, signal.SIGINT):
        signal.signal(name, lambda *_: server.stop())
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # the model at the start corrects until the end
    print_json({"rsi_port": server.port})
    server.run(lambda line: print_line(line, to_stderr=True))
