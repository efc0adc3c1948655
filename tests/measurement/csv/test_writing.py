"""Writing measurement files: values read back, and files are written completely or not at all."""

import os
import stat
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError, OutputError
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.rules import TEMPERATURES
from pisigma.robot import Robot
from pisigma.robot.se3 import rotation_from_quaternion, rotation_from_zyx

TEXT = st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=6).filter(
    lambda text: text == text.strip()
)


def tensor(values: object) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def with_gaps(values: torch.Tensor, gaps: list[bool]) -> torch.Tensor:
    """Values with NaN in some rows."""
    values[torch.tensor(gaps)] = torch.nan
    return values


def approaches(dof: int) -> st.SearchStrategy[list[float]]:
    """Directions of approach of all joints in one row, some of them not given."""
    return st.lists(st.sampled_from([1.0, -1.0, float("nan")]), min_size=dof, max_size=dof)


@st.composite
def written_fields(draw: st.DrawFn, rows: int, dof: int) -> dict[str, object]:
    """All fields of a file, with orientations as quaternions."""

    def each_row(values: st.SearchStrategy[object]) -> list[object]:
        return draw(st.lists(values, min_size=rows, max_size=rows))

    def numbers(count: int, low: float = -1e3, high: float = 1e3) -> torch.Tensor:
        return tensor(each_row(st.lists(st.floats(low, high), min_size=count, max_size=count)))

    def optional(low: float, high: float = 1e3) -> torch.Tensor | None:
        return (
            with_gaps(numbers(1, low, high)[:, 0], each_row(st.booleans())) if draw(st.booleans()) else None
        )

    unseen = each_row(st.sampled_from(["position", "rotation", ""])) if draw(st.booleans()) else None
    quaternion = numbers(4, -1, 1)
    assume(bool((quaternion.norm(dim=-1) > 1e-3).all()))
    return {
        "q": numbers(dof),
        "position": with_gaps(numbers(3), [name == "position" for name in unseen or [""] * rows]),
        "rotation": with_gaps(quaternion, [name == "rotation" for name in unseen]) if unseen else None,
        "frame": tuple(each_row(TEXT)),
        "target": tuple(each_row(TEXT)),
        "sigma_position": optional(1e-9),
        "sigma_rotation": optional(1e-9),
        "split": draw(st.none() | st.just(("train", "test", "train", "train", "test")[:rows])),
        "payload": optional(0.0),
        "temperature": optional(*TEMPERATURES),
        "approach": draw(st.none() | st.just(True)) and tensor(each_row(approaches(dof))),
    }


def assert_same(actual: Measurements, expected: Measurements) -> None:
    """Assert equality to 1e-12 in every field of the file; columns of NaN only are absent when read back."""
    for item in fields(Measurements):
        a, e = getattr(actual, item.name), getattr(expected, item.name)
        if item.name in ("line", "source", "left_out"):
            continue
        if isinstance(e, torch.Tensor) and e.isnan().all():
            e = None
        if not isinstance(e, torch.Tensor):
            assert a == e, item.name
            continue
        assert torch.equal(a.isnan(), e.isnan()), item.name
        assert_close(a[~a.isnan()], e[~e.isnan()], atol=1e-12, rtol=1e-12)


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data(), st.integers(1, 5), st.lists(st.booleans(), min_size=1, max_size=7))
def test_reads_back_what_was_written(tmp_path: Path, data: st.DataObject, rows: int, revolute: list[bool]):
    given_fields = data.draw(written_fields(rows, len(revolute)))
    if given_fields["rotation"] is not None:
        given_fields["rotation"] = rotation_from_quaternion(given_fields["rotation"])
    measurements = Measurements(**given_fields)
    path = tmp_path / "data.csv"
    measurements.write_csv(path, revolute=revolute)
    assert_same(Measurements.read_csv(path), measurements)


@pytest.mark.parametrize("pitch", [-90.0, -90 + 1e-7, 0.0, 90 - 1e-7, 90.0])
@pytest.mark.parametrize("roll", [-180.0, 0.0, 1e-7, 90.0, 180 - 1e-7, 180.0])
def test_rotations_keep_their_digits_where_angles_are_singular(tmp_path: Path, roll: float, pitch: float):
    yaw = [-180.0, -1e-7, 0.0, 60.0, 180.0]
    rpy = torch.deg2rad(tensor([[roll, pitch, angle] for angle in yaw]))
    measurements = Measurements(q=torch.arange(5.0).double()[:, None], rotation=rotation_from_zyx(rpy))
    measurements.write_csv(tmp_path / "data.csv")
    assert_close(Measurements.read_csv(tmp_path / "data.csv").rotation, measurements.rotation, atol=1e-15)
    scalar_parts = [
        float(line.split(",")[7]) for line in (tmp_path / "data.csv").read_text().splitlines()[1:]
    ]
    assert min(scalar_parts) >= 0


def make(rows: int = 2) -> Measurements:
    """Positions of a robot with four joints."""
    generator = torch.Generator().manual_seed(0)
    return Measurements(
        q=-torch.rand(rows, 4, generator=generator, dtype=torch.float64) / 10,
        position=torch.rand(rows, 3, generator=generator, dtype=torch.float64),
    )


def test_units_are_those_of_the_robot(tmp_path: Path):
    path, robot = tmp_path / "data.csv", Robot.load("kiro3")
    make().write_csv(path, robot)
    assert path.read_text().splitlines()[0] == "q1_deg,q2_deg,q3_mm,q4_deg,x_mm,y_mm,z_mm"
    assert_same(Measurements.read_csv(path, robot), make())


def test_joints_are_revolute_by_default(tmp_path: Path):
    make().write_csv(tmp_path / "data.csv")
    assert (tmp_path / "data.csv").read_text().startswith("q1_deg,q2_deg,q3_deg,q4_deg,")


def test_measured_poses_read_back(tmp_path: Path, shared_data: Path):
    robot = Robot.load("ur10")
    measured = Measurements.read_csv(shared_data / "ur10" / "series_c_train.csv", robot)
    measured.write_csv(tmp_path / "data.csv", robot)
    assert_same(Measurements.read_csv(tmp_path / "data.csv", robot), measured)


@pytest.mark.parametrize(
    ("change", "row", "column", "value"),
    [
        ({"position": None}, 0, None, None),
        ({"position": tensor([[1, 2, 3], [torch.nan] * 3])}, 1, None, None),
        ({"target": ("A", " B")}, 1, "target", " B"),
        ({"frame": ("A\nB", "A")}, 0, "frame", "A\nB"),
        ({"frame": ("A", "\udc80")}, 1, "frame", "\udc80"),
    ],
)
def test_refuses_what_would_not_read_back(
    tmp_path: Path, change: dict[str, object], row: int, column: str | None, value: str | None
):
    path = tmp_path / "data.csv"
    path.write_text("as it was")
    with refused(MeasurementError, file="tracker", column=column, value=value) as caught:
        replace(make(), source="tracker", **change).write_csv(path)
    assert f"row {row}" in str(caught.value)
    assert path.read_text() == "as it was"
    assert os.listdir(tmp_path) == ["data.csv"]


def test_refuses_no_rows(tmp_path: Path):
    with refused(MeasurementError, file="memory"):
        make(0).write_csv(tmp_path / "data.csv")


def test_refuses_another_robot(tmp_path: Path):
    with refused(MeasurementError, option="robot", value=6):
        make().write_csv(tmp_path / "data.csv", Robot.load("ur10"))
    with refused(MeasurementError, option="revolute", value=1):
        make().write_csv(tmp_path / "data.csv", revolute=[True])


def test_an_interrupted_writing_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "data.csv"
    path.write_text("as it was")

    def fail(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OutputError):
        make().write_csv(path)
    assert path.read_text() == "as it was"
    assert os.listdir(tmp_path) == ["data.csv"]


def test_the_new_file_takes_the_place_of_the_old_one_in_one_step(tmp_path: Path):
    path, old = tmp_path / "data.csv", tmp_path / "old.csv"
    path.write_text("as it was")
    os.link(path, old)
    make().write_csv(path)
    assert old.read_text() == "as it was"
    assert Measurements.read_csv(path).rows == 2


def test_refuses_a_missing_folder(tmp_path: Path):
    with pytest.raises(OutputError):
        make().write_csv(tmp_path / "nowhere" / "data.csv")


def test_a_link_remains_a_link_with_default_permissions(tmp_path: Path):
    (tmp_path / "plain").write_text("")
    (tmp_path / "link.csv").symlink_to(tmp_path / "data.csv")
    make().write_csv(tmp_path / "link.csv")
    assert (tmp_path / "link.csv").is_symlink()
    rights = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("data.csv", "plain")]
    assert rights[0] == rights[1]
