"""`pisigma upgrade`: convert a model folder of an earlier version."""

from dataclasses import asdict

from pisigma.cli.arguments import AsJson, ModelFolder
from pisigma.cli.output import print_json, print_line, print_lines


def upgrade(model: ModelFolder, as_json: AsJson = False) -> None:
    """Convert a model folder of an earlier version to the present format."""
    from pisigma.model.folder.upgrade import upgrade_folder
    from pisigma.model.inverse.written_model import check_written

    done = upgrade_folder(model, check_written)
    if as_json:
        print_json({"model": str(model), **asdict(done)})
    elif done.before == done.after:
        print_line(f"{model} already has the newest format ({done.after}).")
    else:
        print_lines([f"{model}: format {done.before} was upgraded to {done.after}.", *done.changes])
