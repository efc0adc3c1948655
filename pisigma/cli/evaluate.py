"""`pisigma evaluate`: how well models explain measurements that they were not trained on."""

from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson
from pisigma.cli.output import print_json, print_lines
from pisigma.cli.settings_options import takes_settings
from pisigma.cli.verify import print_comparison
from pisigma.files.errors import AcceptanceError
from pisigma.workflow.settings.evaluation import EvaluationSettings

if TYPE_CHECKING:
    from pisigma.workflow.evaluate import Evaluation

Paths = Annotated[
    list[str],
    typer.Argument(
        metavar="MODEL... DATA",
        help="Model folders, and 'nominal' (the robot as drawn, base and tool fitted) or 'geometric' (what a hybrid "
        "builds upon) of the first that has it; last, measurements (CSV) in the frames that they were fitted in. A "
        "single model is compared with nominal.",
    ),
]
Hashes = Annotated[
    list[str] | None,
    typer.Option(
        "--sha256",
        help="SHA-256 of a model folder's model.yaml, as sha256sum prints it; another model is refused. Once for every "
        "folder, in their order.",
    ),
]


@takes_settings
def evaluate(
    paths: Paths,
    settings: EvaluationSettings,
    sha256: Hashes = None,
    as_json: AsJson = False,
) -> None:
    """Compare models on measurements, with confidence intervals, and accept them or not.

    Rows of the set "train" are left out where the file has a column "set". With a limit, every model folder has to
    meet it, else the exit status is 3; so it is where the base or the tool has moved, and where errors of positions or
    orientations are too large to be those of a calibrated robot: the usual setup faults that explain them are named.
    Balls in sockets, wires and pairs are judged by how well the rows of each agree, and by stated distances.
    """
    from pisigma.files.model_files import check_model_hash
    from pisigma.workflow import evaluate as workflow

    if len(paths) < 2:
        raise typer.BadParameter("a model folder and, last, a file of measurements were wanted.")
    folders = [path for path in paths[:-1] if path not in workflow.REFERENCES]
    if sha256 and len(sha256) != len(folders):
        raise typer.BadParameter(
            f"one for each of the {len(folders)} model folders was wanted, got {len(sha256)}.",
            param_hint="'--sha256'",
        )
    for folder, wanted in zip(folders, sha256 or (), strict=False):
        check_model_hash(folder, wanted)
    evaluation = workflow.evaluate(paths[:-1], paths[-1], settings)
    if as_json:
        print_json(evaluation.to_json())
    else:
        _print(evaluation)
    if not evaluation.accepted:
        missed = [f"not accepted: {'; '.join(evaluation.missed)}."] if evaluation.missed else []
        raise AcceptanceError(" ".join([*missed, *(one.sentence for one in evaluation.diagnostics)]))


def _print(evaluation: "Evaluation") -> None:
    stated = evaluation.settings.limits.stated
    if stated and evaluation.accepted:
        limits = ", ".join(f"{name} {limit:g}" for name, limit in stated.items())
        print_lines([f"Accepted: every model stays within {limits}."])
    elif evaluation.missed:
        print_lines([f"Not accepted: {'; '.join(evaluation.missed)}."])
    print_comparison(evaluation.comparison, evaluation.data)
    print_lines([*(one.sentence for one in evaluation.diagnostics), *evaluation.warnings])
