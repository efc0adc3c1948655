"""`pisigma verify`: whether a correction is active and right, judged from new measurements."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelFolder
from pisigma.cli.output import print_json, print_line, print_lines, print_table, progress_of, screen_width
from pisigma.cli.settings_options import takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.workflow.settings.verification import VerificationSettings

if TYPE_CHECKING:
    from pisigma.validation.held_out.model_comparison import ModelComparison
    from pisigma.workflow.verify import Verification

Hash = Annotated[
    str | None,
    typer.Option(
        "--sha256",
        help="SHA-256 of the model folder's model.yaml, as sha256sum prints it; another model is refused.",
    ),
]
Data = Annotated[
    Path, typer.Argument(help="New measurements (CSV) at the joint values that the robot was commanded to.")
]


@takes_settings
def verify(
    model: ModelFolder,
    data: Data,
    settings: VerificationSettings,
    sha256: Hash = None,
    as_json: AsJson = False,
) -> None:
    """Say whether new measurements are explained better by the corrected model than by the nominal robot.

    Where a joint, a length, the base or the tool has moved since the model was made, it says by how much, and prints
    the line that recalibrates. Where errors are large, the usual setup faults that explain them are named: units,
    order, signs or zeros of the joints, a correction that was applied twice or not at all. Balls in sockets, wires and
    pairs are judged by how well the rows of each agree, and by stated distances. Rows of the set "train" are left out.
    Exit status 3 where the corrected model does not explain the measurements better, or the arm has moved.
    """
    from pisigma.files.model_files import check_model_hash
    from pisigma.workflow import verify as workflow

    if sha256 is not None:
        check_model_hash(model, sha256)
    with progress_of(f"verifying {model}"):
        verification = workflow.verify(model, data, settings)
    if as_json:
        print_json(verification.to_json())
    else:
        _print(verification)
    if not verification.accepted:
        raise AcceptanceError(verification.sentence)


def _print(verification: "Verification") -> None:
    """Print the verdict and what to run, the errors, and what else is wrong."""
    print_lines([verification.sentence])
    if verification.recalibration:
        print_line(f"Run {verification.recalibration}")
    print_comparison(verification.comparison, verification.data)
    print_lines([*(fault.sentence for fault in verification.setup_faults), *verification.warnings])


def print_comparison(comparison: "ModelComparison", data: str) -> None:
    """Print the tables of models that were compared on the rows of a file."""
    from pisigma.reporting.comparison_tables import comparison_tables
    from pisigma.reporting.tables import distance_table

    for title, table in comparison_tables(comparison, Path(data).name, screen_width()):
        print_table(title, *table)
    if comparison.socket_distance is not None:
        print_table("stated distances of sockets", *distance_table(comparison.socket_distance))
