"""`pisigma open`: a cell as a page in the browser."""

import signal
import sys
import tempfile
import threading
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from pisigma.cli.arguments import AsJson
from pisigma.cli.cell import CellFolder
from pisigma.cli.output import print_json, print_line
from pisigma.cli.settings_options import takes_settings
from pisigma.files.setting import Option


@dataclass(frozen=True)
class PageAddress:
    """Address at which the page of a cell is served.

    Attributes:
        host: address at which to serve the page; 0.0.0.0 or an address of this machine in the network makes the page
            accessible to other machines.
        port: port of the page; the next free port is used if it is occupied.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, Option(min=1, max=65535)] = 8080


@takes_settings
def open_(
    cell: CellFolder,
    address: PageAddress,
    rows: Annotated[
        Path | None,
        typer.Option("--rows", help="Measurement file (CSV) whose new rows appear on the page."),
    ] = None,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the link.")] = False,
    as_json: AsJson = False,
) -> None:
    """Open a cell as a page in the browser, until Ctrl-C; in an empty or new folder, the page creates the cell.

    Prints the link to the page as its first line. Only people who have this link can open the page.
    """
    from pisigma.workbench.workbench import Workbench

    ended = threading.Event()
    for name in (signal.SIGTERM, signal.SIGINT):
        signal.signal(name, lambda *_: ended.set())
    with Workbench(cell, address.host, address.port, rows) as bench:
        if as_json:
            print_json({"url": bench.url})
        else:
            print_line(bench.url)
            print_line(
                "Only people who have this link can open the page. It is served until you press Ctrl-C.",
                to_stderr=True,
            )
        sys.stdout.flush()
        with tempfile.TemporaryDirectory(prefix="pisigma-") as folder:
            if not no_browser:
                _open_browser(bench.url, Path(folder))
            ended.wait()


def _open_browser(url: str, folder: Path) -> None:
    """Open a link through a file that only this user can read; command lines are visible to all users."""
    page = folder / "open.html"
    page.touch(mode=0o600)
    page.write_text(f'<!doctype html><title>pisigma</title><meta http-equiv="refresh" content="0;url={url}">')
    webbrowser.open(page.as_uri())
