"""The reader of measurement files names the command that imports an export."""

from pathlib import Path

import pytest

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements

ROWS = "170,-20,1200.5,-300,400\n171,-21,1201.5,-301,401\n"


@pytest.mark.parametrize(
    ("text", "command"),
    [
        (f"q1_deg,q2_deg,x_mm,y_mm,z_mm\n{ROWS}".replace(",", ";").replace(".", ","), " --out data.csv"),
        (f"j1,j2,x,y,z\n{ROWS}", " --unit mm,deg --out data.csv"),
        (
            f"name,x,y,z\n{ROWS.replace('170,', 'p').replace('171,', 'q')}",
            " JOINTS --join point --unit mm --out data.csv",
        ),
        (f"name,A1,A2\np1,170,20\n{'p2,171,30'}\n", " MEASURED --join point --out data.csv"),
        (
            "J1 [deg],J2 [deg],X [mm],Y [mm],Z [mm],A [deg],B [deg],C [deg]\n1,2,3,4,5,6,7,8\n",
            " --rotation MAKER --out data.csv",
        ),
    ],
)
def test_exports(tmp_path: Path, text: str, command: str):
    path = tmp_path / "export.csv"
    path.write_text(text)
    with pytest.raises(MeasurementError) as problem:
        Measurements.read_csv(path)
    assert str(problem.value).endswith(
        f" The command `pisigma import {path}{command}` would read it as an export."
    )


@pytest.mark.parametrize(
    "text",
    [f"q1_deg,q2_degg,x_mm,y_mm,z_mm\n{ROWS}", f"q1_deg,q2_deg,x_mm,y_mm,x_mm\n{ROWS}", "", "only words\n"],
)
def test_no_command_imports_these(tmp_path: Path, text: str):
    path = tmp_path / "export.csv"
    path.write_text(text)
    with pytest.raises(MeasurementError) as problem:
        Measurements.read_csv(path)
    assert "pisigma import" not in str(problem.value)
