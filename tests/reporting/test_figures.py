"""Figures as PNG without a display, and the energy as CSV."""

import csv
import os
import subprocess
import sys

import pytest
import torch
from testing.closeness import assert_close

from pisigma.reporting.figures import draw_energy, draw_errors_over_workspace, write_energy_csv

PNG = b"\x89PNG\r\n\x1a\n"


def size(path) -> tuple[int, int]:
    """Width and height of a PNG."""
    content = path.read_bytes()
    assert content[:8] == PNG
    return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")


def test_energy_csv_has_every_epoch_and_digit(tmp_path, generator):
    energies = torch.rand(7, 2, generator=generator, dtype=torch.float64) * 1e-9
    write_energy_csv(["theta_1", "theta_2"], energies, tmp_path / "energy.csv")
    head, *rows = csv.reader((tmp_path / "energy.csv").read_text().splitlines())
    assert head == ["epoch", "energy_theta_1", "energy_theta_2"]
    assert [row[0] for row in rows] == ["1", "2", "3", "4", "5", "6", "7"]
    assert_close([[float(cell) for cell in row[1:]] for row in rows], energies)


def test_energy_of_0_can_be_drawn(tmp_path):
    draw_energy(["theta_1"], torch.tensor([[1.0], [0.0]], dtype=torch.float64), tmp_path / "energy.png")
    assert min(size(tmp_path / "energy.png")) > 400


@pytest.mark.parametrize(("rows", "joints"), [(1, 1), (50, 1), (50, 6)])
def test_workspace_grows_with_the_joints(tmp_path, generator, rows, joints):
    position, before, after = (
        torch.rand(rows, columns, generator=generator, dtype=torch.float64) for columns in (3, joints, joints)
    )
    path = tmp_path / "workspace.png"
    draw_errors_over_workspace(
        [f"q{i}" for i in range(joints)], ["mm"] * joints, position, before, 0 * after, path
    )
    width, height = size(path)
    assert width > 900
    assert height > 200 * joints


def test_drawing_does_not_set_the_global_backend():
    """Neither pyplot nor a backend is chosen for a program that draws on the screen."""
    script = (
        "import sys\nimport pisigma.reporting.figures\nimport matplotlib\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
        "assert matplotlib.get_backend(auto_select=False) is None\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
