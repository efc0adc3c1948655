"""Hostile exports of instruments and controllers: damaged text, and wrong options."""

from pathlib import Path

from hostile.case import Case, Rng, one_of
from hostile.clean import Clean
from hostile.damage import damaged
from testing.models import no_type_checker

from pisigma.measurement.dataset import Measurements

EXPORTS = Path(__file__).parents[1] / "measurement" / "foreign" / "exports"
_FILES = (
    ("kuka.csv",),
    ("abb.txt",),
    ("fanuc.txt",),
    ("ur_rtde.csv",),
    ("staubli.csv",),
    ("matrices.txt",),
    ("excel_german.csv",),
    ("polyworks_points.csv", "polyworks_log.csv"),
    ("leica_list.txt", "leica_log.csv"),
)
_OPTIONS = (
    (), (), (), ("--unit", "mm,deg"), ("--unit", "m,rad"), ("--rotation", "staubli"), ("--rotation", "none"),
    ("--set", "decimal=comma"), ("--join", "point"), ("--join", "time", "--within", "0.2s"), ("--join", "order"),
    ("--map", "X=x_mm"), ("--map", "1=q1_deg,2=-"), ("--map", "=,=,="), ("--map", "A1=q1_\x1b"), ("--json",),
    ("--save-map", "map.yaml"), ("--within", "1e9s"), ("--unit", "°,µm"),
)  # fmt: skip


def wrong_export(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Write an export with damaged text; rows that are still imported need the values of the export."""
    names = one_of(rng, _FILES)
    hit = one_of(rng, names)
    what = ""
    for name in names:
        content = (EXPORTS / name).read_bytes()
        if name == hit:
            what, content = damaged(rng, content)
        (folder / name).write_bytes(content)
    options = (
        ("--join", "point") if "polyworks_log.csv" in names else ("--join", "time") if len(names) > 1 else ()
    )
    more = one_of(rng, _OPTIONS)
    arguments = ("import", *names, "--out", "data.csv", "--yes", *options, *more)
    states_units = {"--unit", "--map"} & set(
        more
    ) or "word" in what  # "m" for "mm" in the file, which it warns of
    return Case(f"{hit}: {what}", arguments, check=None if states_units else _wrong_values)


def _wrong_values(folder: Path) -> str:
    """Return a fault where no row is one of the export's: a wrong unit or order makes all rows wrong."""
    reference = Measurements.read_csv(EXPORTS / "reference.csv")
    with no_type_checker():
        data = Measurements.read_csv(folder / "data.csv")
    if (
        data.rows < 3 or data.dof != reference.dof
    ):  # the robot of the calibration says that a joint is missing
        return ""
    if data.position is None or reference.position is None:
        return "no positions"
    apart = (data.q[:, None] - reference.q).abs().amax(-1) + (
        data.position[:, None] - reference.position
    ).abs().amax(-1)
    return (
        ""
        if bool((apart < 1e-8).any())
        else f"all rows differ from the export, by {float(apart.min()):.3g} at least"
    )
