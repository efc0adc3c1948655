"""Hostile cells and settings of plans."""

from pathlib import Path

import yaml
from hostile.case import Case, Rng, one_of
from hostile.clean import Clean
from hostile.damage import NUMBERS
from hostile.documents import written
from testing.cells import CELL

from pisigma.planning.plan_file import read_plan

_VALUES = {
    "--count": ("0", "-1", "3", "19", "21", "100000", "9" * 30, "x"),
    "--check": ("0", "-1", "18", "100000", "x"),
    "--set=candidates": ("0", "1", "-5", "30", "1e9", "x"),
    "--set=box": (
        "1,2,3",
        "0,0,0,1,1,1",
        "-9e9,-9e9,-9e9,9e9,9e9,9e9",
        "nan,0,0,1,1,1",
        "3000,0,0,-3000,1,1",
        "a,b,c,d,e,f",
    ),
    "--sensor": ("pose", "distance", "camera", ""),
    "--set=sigma_mm": ("0", "-1", "nan", "1e-300", "1e300", "0.5"),
    "--set=criterion": ("I", "D", "E", ""),
    "--limit-mm": ("0", "nan", "1e-300", "1e300", "inf"),
    "--set=speed_deg_s": ("0", "-3", "inf", "nan", "1e-300"),
    "--set=settling_s": ("-1", "nan", "inf", "0"),
    "--program": ("rows.csv", "x.src", "class.src", "x" * 300 + ".ls", ".script", "no/x.mod", "poses.csv"),
    "--task": ("rows.csv", "missing.csv", "cell.yaml", "/dev/zero", ""),
    "--measured": ("rows.csv", "missing.csv", "cell.yaml"),
    "--set=candidates_from": ("rows.csv", "missing.csv", "cell.yaml", "poses.csv"),
    "--set=seed": ("-1", "9" * 30, "0.5"),
    "--out": ("", ".", "cell.yaml", "no/poses.csv", "poses.txt", "/dev/full", "a" * 400 + ".csv"),
}


def wrong_plan(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Return a plan in a damaged cell, or with a wrong option."""
    cell, rows = folder / "cell.yaml", folder / "rows.csv"
    cell.write_text(yaml.safe_dump(CELL.model_dump(mode="json", exclude_none=True)), encoding="utf-8")
    q = rng.uniform(-40, 40, (int(rng.integers(1, 30)), 6))
    lines = [",".join([*(f"{value:.3f}" for value in row), one_of(rng, NUMBERS)]) for row in q]
    rows.write_text(
        "\n".join([",".join(f"q{i}_deg" for i in range(1, 7)) + ",x_mm", *lines]), encoding="utf-8"
    )
    stated = {
        "--count": "2",
        "--check": "1",
        "--set=candidates": "20",
        "--out": "poses.csv",
        "--surroundings": "cell.yaml",
    }
    if rng.random() < 0.6:
        what, content = written(rng, cell)
        cell.write_bytes(content)
    else:
        option = one_of(rng, list(_VALUES))
        stated[option] = one_of(rng, _VALUES[option])
        what = f"{option} {stated[option][:30]!r}"
    return Case(
        what,
        ("plan", "fanuc_r2000", *(f"{option}={value}" for option, value in stated.items())),
        check=_not_allowed,
    )


def _not_allowed(folder: Path) -> str:
    """Return the first planned pose that is not allowed in its cell; "" for none."""
    plan = read_plan(folder / "poses.csv")
    faults = plan.arm.faults(plan.q)
    return next((sentence for pose in range(len(plan.q)) if (sentence := faults.sentence(pose))), "")
