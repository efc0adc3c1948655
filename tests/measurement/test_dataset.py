"""Data sets of measurements: validation, selection and hash."""

from dataclasses import FrozenInstanceError, replace

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement import UnusableRow
from pisigma.measurement.dataset import Measurements, join
from pisigma.robot.se3 import rotation_from_quaternion


def make_measurements(rows: int = 4, dof: int = 3, seed: int = 0) -> Measurements:
    """Measurements with every field filled."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64) + 0.1

    return Measurements(
        q=random(rows, dof),
        position=random(rows, 3),
        rotation=rotation_from_quaternion(random(rows, 4)),
        frame=tuple(f"frame {row}" for row in range(rows)),
        target=tuple("ABC"[row % 3] for row in range(rows)),
        sigma_position=random(rows),
        sigma_rotation=random(rows),
        split=tuple("train" if row % 2 else "test" for row in range(rows)),
        payload=random(rows),
        temperature=random(rows),
        approach=random(rows, dof).round() * 2 - 1,
        date=tuple(f"2026-11-{row + 1:02d}" for row in range(rows)),
        line=tuple(range(2, rows + 2)),
        source="tracker.csv",
        left_out=(UnusableRow(9, "column 'x_mm': empty"),),
    )


def zeros(*shape: int) -> torch.Tensor:
    return torch.zeros(*shape, dtype=torch.float64)


def test_missing_names_are_filled_in():
    measurements = Measurements(q=zeros(3, 2))
    assert (measurements.rows, measurements.dof, measurements.kinds) == (3, 2, set())
    assert measurements.frame == measurements.target == ("", "", "")
    assert measurements.line == (0, 0, 0)
    assert measurements.place(1) == "memory, row 1"


def test_measurements_may_have_no_rows():
    measurements = Measurements(q=zeros(0, 6), position=zeros(0, 3), rotation=zeros(0, 3, 3))
    assert measurements.T.shape == (0, 4, 4)
    assert measurements.select(torch.zeros(0, dtype=torch.bool)).rows == 0


def test_is_frozen():
    with pytest.raises(FrozenInstanceError):
        make_measurements().source = "other"


def test_poses_contain_position_and_rotation():
    measurements = make_measurements()
    assert measurements.kinds == {"pose"}
    assert_close(measurements.T[:, :3, 3], measurements.position)
    assert_close(measurements.T[:, :3, :3], measurements.rotation)
    assert_close(measurements.T[:, 3], torch.eye(4, dtype=torch.float64)[3].expand(4, 4))


@pytest.mark.parametrize(("missing", "word"), [("rotation", "orientation"), ("position", "position")])
def test_poses_need_position_and_rotation(missing: str, word: str):
    with refused(MeasurementError, file="tracker.csv", value=f"no {word}"):
        _ = replace(make_measurements(), **{missing: None}).T


@pytest.mark.parametrize(
    ("field", "value", "line", "stated"),
    [
        ("q", zeros(4), None, (4,)),
        ("q", zeros(4, 0), None, (4, 0)),
        ("q", zeros(4, 3).float(), None, torch.float32),
        ("position", zeros(3, 3), None, (3, 3)),
        ("position", zeros(4, 3).float(), None, torch.float32),
        ("position", torch.full((4, 3), torch.inf, dtype=torch.float64), 2, [torch.inf] * 3),
        ("rotation", zeros(4, 3, 3), 2, [[0.0] * 3] * 3),
        ("sigma_position", zeros(4), 2, 0.0),
        ("sigma_rotation", zeros(4) - 1, 2, -1.0),
        ("payload", zeros(4) - 1, 2, -1.0),
        ("payload", zeros(4) + 5000, 2, 5000.0),
        ("temperature", zeros(5), None, (5,)),
        ("approach", zeros(4), None, (4,)),
        ("frame", ("a",), None, 1),
        ("line", (1, 2), None, 2),
        ("date", ("2026-11-01", "", "1.11.2026", ""), 4, "1.11.2026"),
        ("split", ("train", "test", "trian", "test"), 4, "trian"),
    ],
)
@pytest.mark.usefixtures("without_type_checker")
def test_refuses_what_does_not_fit(field: str, value: object, line: int | None, stated: object):
    names = {"option": field} if line is None else {"column": field}
    with refused(MeasurementError, file="tracker.csv", line=line, value=stated, **names):
        replace(make_measurements(), **{field: value})


@pytest.mark.parametrize(
    ("field", "value", "column"),
    [
        ("q", torch.full((4, 3), torch.nan, dtype=torch.float64), "q"),
        ("position", torch.tensor([[0, 0, torch.nan]] * 4, dtype=torch.float64), "position"),
        ("rotation", -torch.eye(3, dtype=torch.float64).repeat(4, 1, 1), "rotation"),
        ("approach", zeros(4, 3), "approach1"),
    ],
)
def test_refuses_impossible_values_of_a_row(field: str, value: torch.Tensor, column: str):
    with refused(MeasurementError, file="tracker.csv", line=2, column=column):
        replace(make_measurements(), **{field: value})


@pytest.mark.parametrize(
    "index", [torch.tensor([2, 0]), torch.tensor([True, False, True, False])], ids=["index", "mask"]
)
def test_select_keeps_all_fields(index: torch.Tensor):
    measurements = make_measurements()
    rows = [2, 0] if index.dtype == torch.int64 else [0, 2]
    chosen = measurements.select(index)
    for name in (
        *("q", "position", "rotation", "sigma_position", "sigma_rotation"),
        *("payload", "temperature", "approach"),
    ):
        assert_close(getattr(chosen, name), getattr(measurements, name)[rows])
    for name in ("frame", "target", "split", "line"):
        assert getattr(chosen, name) == tuple(getattr(measurements, name)[row] for row in rows)
    assert (chosen.source, chosen.left_out) == (measurements.source, measurements.left_out)


def test_select_keeps_fields_absent():
    chosen = Measurements(q=zeros(3, 2), position=zeros(3, 3)).select(torch.tensor([1]))
    assert chosen.rotation is None
    assert chosen.split is None


@pytest.mark.parametrize(
    ("index", "value"),
    [
        (torch.tensor([0, 4]), "0 to 4"),
        (torch.tensor([-1]), "-1 to -1"),
        (torch.tensor([True]), 1),
        (torch.tensor([[0]]), "torch.int64 of shape (1, 1)"),
        (torch.tensor([0], dtype=torch.int32), "torch.int32 of shape (1,)"),
        (torch.tensor([0.0]), "torch.float32 of shape (1,)"),
    ],
)
def test_select_refuses_other_indices(index: torch.Tensor, value: object):
    with refused(MeasurementError, option="index", value=value):
        make_measurements().select(index)


def test_the_hash_depends_on_values_only():
    measurements = make_measurements()
    elsewhere = replace(measurements, source="other.csv", line=(), left_out=())
    assert measurements.content_hash() == elsewhere.content_hash() == make_measurements().content_hash()
    assert len(measurements.content_hash()) == 64


@pytest.mark.parametrize(
    "name", ["q", "position", "sigma_position", "sigma_rotation", "payload", "temperature"]
)
def test_the_hash_depends_on_every_digit(name: str):
    measurements = make_measurements()
    values = getattr(measurements, name).clone()
    values.view(-1)[-1] *= 1 + 2e-16
    changed = replace(measurements, **{name: values})
    assert changed.content_hash() != measurements.content_hash()


@pytest.mark.parametrize(
    "change", [{"target": ("A", "A", "A", "A")}, {"rotation": None}, {"split": None}, {"approach": None}]
)
def test_the_hash_depends_on_names_and_absent_fields(change: dict[str, object]):
    measurements = make_measurements()
    assert replace(measurements, **change).content_hash() != measurements.content_hash()


def test_concatenation_without_approaches_fills_nan():
    with_approach, without = make_measurements(), replace(make_measurements(seed=1), approach=None)
    joined = join([with_approach, without])
    assert_close(joined.approach[:4], with_approach.approach)
    assert bool(joined.approach[4:].isnan().all())


def test_the_hash_is_equal_for_all_nans_and_zeros():
    plain = Measurements(q=zeros(1, 1), position=torch.full((1, 3), torch.nan, dtype=torch.float64))
    other = Measurements(q=-zeros(1, 1), position=-torch.full((1, 3), torch.nan, dtype=torch.float64))
    assert plain.content_hash() == other.content_hash()
