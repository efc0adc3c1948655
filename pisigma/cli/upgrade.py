"""`pisigma upgrade`: convert a model folder or a cell of an earlier version."""

from pisigma.cli.arguments import AsJson, ModelOrCell
from pisigma.cli.output import print_json, print_lines


def upgrade(model: ModelOrCell, as_json: AsJson = False) -> None:
    """Convert a model folder or a cell of an earlier version to the current format, with its history."""
    from pisigma.lifetime.cell.layout import is_cell, is_cell_of_arms
    from pisigma.workflow.cell.transfer import upgrade as workflow

    done = workflow(model)
    before, after = done.schema_before, done.schema_after
    models = [
        {"name": one.name, "before": one.format_before, "after": one.format_after, "changes": one.changes}
        for one in done.models
    ]
    if as_json and is_cell(model):
        print_json({"cell": str(model), "before": before, "after": after, "models": models})
    elif as_json:
        print_json({"model": str(model), **models[0]})
    else:
        if before != after:
            print_lines([f"{model}: history of schema version {before} was upgraded to {after}."])
        elif is_cell(model) and not is_cell_of_arms(model):
            print_lines([f"The history of {model} already has the newest schema version ({after})."])
        for one in done.models:
            name = f"model '{one.name}'" if is_cell(model) else str(model)
            if one.format_before == one.format_after:
                print_lines([f"{name}: {change}" for change in one.changes])
                print_lines([f"{name} already has the newest format ({one.format_after})."])
            else:
                print_lines(
                    [f"{name}: format {one.format_before} was upgraded to {one.format_after}.", *one.changes]
                )
