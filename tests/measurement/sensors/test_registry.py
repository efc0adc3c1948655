"""Sensors that somebody else defines: from columns of a file through the calibration to held-out errors."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from torch import Tensor

import pisigma
from pisigma.files.errors import IdentificationError, MeasurementError
from pisigma.measurement.dataset import join
from pisigma.measurement.readings import READINGS
from pisigma.measurement.sensors import (
    SENSORS,
    AbstractSensor,
    InitialUnknowns,
    ReadingColumn,
    Readings,
    RowFault,
    SensorReadings,
    SensorRows,
    UnknownDerivative,
    UnknownGroup,
    Unknowns,
    register_sensor,
)
from pisigma.measurement.sensors.sensor import component_along, distinct_names, indices_of_names, owners_of
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion


def tilts_of(R: Tensor) -> Tensor:
    """Angles about x and y of the tool [rad], as an inclinometer on it shows them."""
    return torch.stack([torch.atan2(R[..., 2, 1], R[..., 2, 2]), -torch.asin(R[..., 2, 0])], -1)


def too_steep(readings: Readings) -> Iterator[RowFault]:
    """Find rows beyond the inclinometer's range."""
    pitch = np.asarray(readings["tilt_y"])
    yield np.abs(pitch) > np.pi / 2, lambda row: f"{pitch[row]:.3g} rad is beyond 90 deg; correct it"


@dataclass(frozen=True, eq=False)
class Inclinometer(AbstractSensor):
    """Two angles of the tool against the z axis of the frame."""

    name = "tilt"
    unit = "rad"
    components = 2
    depends_on_rotation = True
    readings = SensorReadings(
        "tilt",
        (ReadingColumn("tilt_x", ("deg", "rad")), ReadingColumn("tilt_y", ("deg", "rad"))),
        is_length=False,
        row_faults=too_steep,
    )
    measured: Tensor  # (2, rows)
    up: Tensor  # (3, rows): the frame's z axis as seen from the base's anchor
    tool: Tensor  # (3, 3, rows): anchor of the tool's rotation
    present: Tensor
    sigma: Tensor | None

    @classmethod
    def build(cls, rows: SensorRows) -> "Inclinometer | None":
        present = rows.measurements.is_measured("tilt")
        if not bool(present.any()):
            return None
        measured = torch.stack([rows.readings("tilt_x"), rows.readings("tilt_y")])
        up, tool = rows.base_anchors[:, 2, :3].t(), rows.tool_rotation_anchors.permute(1, 2, 0)
        return cls(torch.where(present, measured, 0.0), up, tool, present, rows.sigma(present, "rad"))

    def _up_in_tool(self, R: Tensor, rows: slice, up: Tensor) -> Tensor:
        return torch.einsum("jln,jn->ln", self.tool[..., rows], torch.einsum("ijn,in->jn", R, up))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Tensor:
        x, y, z = self._up_in_tool(motion.rotation, rows, self.up[:, rows])
        return self.measured[:, rows] - torch.stack([torch.atan2(y, z), -torch.asin(x)])

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Tensor:
        x, y, z = self._up_in_tool(motion.rotation, rows, self.up[:, rows])
        up = self.up[:, rows].expand(len(motion.derivative), -1, -1)
        turned = torch.linalg.cross(up, motion.derivative[:, 3:], dim=1)
        dx, dy, dz = torch.stack(
            [self._up_in_tool(motion.rotation, rows, one) for one in turned], 1
        )  # a parameter each
        return torch.stack([(z * dy - y * dz) / (y * y + z * z), -dx / (1 - x * x).sqrt()], 1)


@dataclass(frozen=True, eq=False)
class HeightGauge(AbstractSensor):
    """The height of the tool in its frame above the zero of a gauge, which is unknown."""

    name = "height"
    unit = "m"
    components = 1
    readings = SensorReadings(
        "height", (ReadingColumn("height", ("mm", "m")), ReadingColumn("gauge", is_text=True))
    )
    measured: Tensor  # (rows,)
    up: Tensor  # (3, rows)
    gauge: Tensor  # (rows,): index of the gauge
    present: Tensor
    sigma: Tensor | None

    @classmethod
    def build(cls, rows: SensorRows) -> "HeightGauge | None":
        present = rows.measurements.is_measured("height")
        if not bool(present.any()):
            return None
        names = gauges(rows.measurements)
        measured = torch.where(present, rows.readings("height") - rows.base_anchors[:, 2, 3], 0.0)
        up = rows.base_anchors[:, 2, :3].t()
        return cls(
            measured, up, rows.name_indices(names, distinct_names(names)), present, rows.sigma(present)
        )

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Tensor:
        predicted = (self.up[:, rows] * motion.position).sum(0) - unknowns["gauge"][0, self.gauge[rows]]
        return (self.measured[rows] - predicted)[None]

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Tensor:
        return component_along(self.up[:, rows], motion.derivative)

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        owner = self.gauge[rows]
        return (UnknownDerivative("gauge", owner, -torch.ones(1, 1, len(owner), dtype=torch.float64)),)

    @classmethod
    def unknowns(cls, measurements: pisigma.Measurements) -> UnknownGroup | None:
        owners, frames = owners_of(measurements, gauges(measurements))
        return UnknownGroup("gauge", ("zero",), owners, frames) if owners else None

    @classmethod
    def initial_guess(
        cls, measurements: pisigma.Measurements, T_frame_tool: Tensor, reach: float
    ) -> InitialUnknowns | None:
        names = distinct_names(gauges(measurements))
        if not names:
            return None
        number = indices_of_names(gauges(measurements), names, measurements.rows)
        off = T_frame_tool[:, 2, 3] - measurements.readings["height"]
        zeros = torch.stack([off[number == k].median() for k in range(len(names))])[:, None]
        return InitialUnknowns(zeros, torch.ones_like(zeros, dtype=torch.bool))


def gauges(measurements: pisigma.Measurements) -> tuple[str, ...] | None:
    names = measurements.readings.get("gauge")
    return names if isinstance(names, tuple) else None


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    """Both sensors in the registry, for one test."""
    for sensor in (Inclinometer, HeightGauge):
        register_sensor(sensor)
    yield
    for sensor in (Inclinometer, HeightGauge):
        del SENSORS[sensor.name], READINGS[sensor.name]


def true_arm() -> tuple[pisigma.Robot, pisigma.Robot]:
    """A nominal robot, and one with errors."""
    drawn = pisigma.Robot.load("ur5")
    rng = np.random.default_rng(0)
    errors = 5e-4 * rng.standard_normal(drawn.dh.shape)
    base = np.array([0.4, -0.3, 0.2, 0.5, 0.02, -0.03])
    return drawn, drawn.with_geometry(
        drawn.dh + errors, base=base, tool=np.array([0.03, 0.05, 0.1, 0.0, 0.0, 0.0])
    )


def measured(rows: int, noise: float = 1e-6) -> tuple[pisigma.Robot, pisigma.Measurements]:
    """Positions with tilts, and heights above two gauges."""
    drawn, true = true_arm()
    rng = np.random.default_rng(1)
    q = torch.from_numpy(rng.uniform(-2, 2, (rows, drawn.dof)))
    T = forward_kinematics(true, q)

    def noisy(values: Tensor) -> Tensor:
        return values + torch.from_numpy(noise * rng.standard_normal(tuple(values.shape)))

    tilt = noisy(tilts_of(T[:, :3, :3]))
    tracker = pisigma.Measurements(
        q=q, position=noisy(T[:, :3, 3]), readings={"tilt_x": tilt[:, 0], "tilt_y": tilt[:, 1]}
    )
    zeros = torch.tensor([0.05, -0.02], dtype=torch.float64)[torch.arange(rows) % 2]
    gauge = tuple("ab"[row % 2] for row in range(rows))
    height = pisigma.Measurements(
        q=q + 0.01,
        readings={"height": noisy(forward_kinematics(true, q + 0.01)[:, 2, 3]) - zeros, "gauge": gauge},
    )
    return drawn, join([tracker, height])


def test_files_hold_the_columns_of_registered_sensors(tmp_path: Path) -> None:
    robot, data = measured(6)
    data.write_csv(tmp_path / "data.csv", robot)
    header = (tmp_path / "data.csv").read_text().splitlines()[0].split(",")
    assert {"tilt_x_deg", "tilt_y_deg", "height_mm", "gauge"} <= set(header)
    back = pisigma.Measurements.read_csv(tmp_path / "data.csv", robot)
    assert back.kinds == {"position", "tilt", "height"}
    assert gauges(back) == ("",) * 6 + tuple("ababab")
    for name in ("tilt_x", "tilt_y", "height"):
        a, b = back.readings[name], data.readings[name]
        assert_close(a[~a.isnan()], b[~b.isnan()], rtol=1e-12)
    some = back.select(torch.tensor([7, 0]))
    assert gauges(some) == ("b", "")
    assert some.content_hash() != back.select(torch.tensor([6, 0])).content_hash()


def test_a_calibration_uses_the_rows_and_evaluates_held_out_rows() -> None:
    robot, data = measured(60)
    test = torch.arange(data.rows) % 4 == 0
    result = pisigma.GeometricCalibrator(robot).fit(data.select(~test))
    assert {noise.sensor for noise in result.noise} == {"position", "tilt", "height"}
    assert all(noise.sigma < 3e-6 for noise in result.noise)
    assert_close(result.sensor_unknowns["gauge"]["a"], np.array([0.05]), atol=2e-5)
    errors = result.errors_of(data.select(test))
    assert {name: len(values[0]) for name, values in errors.items()} == {
        "position": 3,
        "tilt": 2,
        "height": 1,
    }
    for name, values in errors.items():
        sizes = values[torch.isfinite(values).all(-1)].norm(dim=-1)
        assert len(sizes) == 15, name
        assert float(sizes.max()) < 3e-5, name


def test_their_derivatives_are_those_of_the_predicted_values() -> None:
    robot, data = measured(8)
    setup = pisigma.GeometricCalibrator(robot).build(data)
    problem, everything = setup.problem, torch.arange(len(setup.start))
    rows = slice(0, problem.q.shape[0])

    def residuals(at: Tensor) -> list[Tensor]:
        motion = problem.motion(at, rows, everything)
        own = problem.space.sensor_unknowns(at)
        return [sensor.residual(motion, own, rows) for sensor in problem.sensors]

    motion, own = problem.motion(setup.start, rows, everything), problem.space.sensor_unknowns(setup.start)
    for k, sensor in enumerate(problem.sensors):
        J = problem.prediction_derivative(sensor, motion, own, rows, everything)
        for i in everything.tolist():
            step = torch.zeros_like(setup.start)
            step[i] = 1e-6
            change = (residuals(setup.start - step)[k] - residuals(setup.start + step)[k]) / 2e-6
            assert_close(J[i][:, sensor.present], change[:, sensor.present], atol=1e-8)


@pytest.mark.parametrize(
    ("content", "line", "column", "name"),
    [
        ("q1_deg,tilt_x_deg\n1,2\n", 1, "tilt_x_deg", "tilt_y_deg"),
        ("q1_deg,tilt_x_deg,tilt_y_deg\n1,2,3\n2,,3\n", 3, "tilt_x_deg", "'tilt_y_deg'"),
        ("q1_deg,tilt_x_deg,tilt_y_deg\n1,2,91\n", 2, "tilt_x_deg", "1.59 rad"),
        ("q1_deg,x_mm,y_mm,z_mm,height_mm,gauge\n1,1,2,3,4,a\n", 2, "x_mm", "height_mm"),
        ("q1_deg,tilt_x_deg,tilt_z_deg\n1,2,3\n", 1, "tilt_z_deg", "'tilt_"),
    ],
)
def test_faulty_readings_are_refused(tmp_path: Path, content: str, line: int, column: str, name: str) -> None:
    path = tmp_path / "data.csv"
    path.write_text(content)
    with refused(MeasurementError, file=path, line=line, column=column) as caught:
        pisigma.Measurements.read_csv(path)
    assert name in str(caught.value)


def test_readings_in_memory_are_checked_too() -> None:
    data = measured(4)[1].select(torch.arange(4))
    steep = dict(data.readings) | {"tilt_y": torch.full((4,), 2.0, dtype=torch.float64)}
    with refused(MeasurementError, column="tilt") as caught:
        replace(data, readings=steep)
    assert "row 0" in str(caught.value)
    with refused(MeasurementError, option="readings", value="tilt") as caught:
        replace(data, readings={"tilt": torch.zeros(4, dtype=torch.float64)})
    assert "'tilt_" in caught.value.remedy


def test_names_that_are_taken_are_refused() -> None:
    with refused(MeasurementError, value="tilt"):
        register_sensor(Inclinometer)

    @dataclass(frozen=True, eq=False)
    class Other(HeightGauge):
        name = "other"

    with refused(MeasurementError, value="height_mm"):
        register_sensor(Other)


def test_a_gauge_that_was_not_calibrated_is_refused() -> None:
    robot, data = measured(40)
    names = gauges(data)
    assert names is not None
    only_a = torch.tensor([name != "b" for name in names])
    result = pisigma.GeometricCalibrator(robot).fit(data.select(only_a))
    with refused(IdentificationError, value="b") as caught:
        result.errors_of(data)
    assert "row 41" in str(caught.value)


def test_the_workflow_evaluates_the_rows_by_cross_validation() -> None:
    robot, data = measured(40)
    calibration = pisigma.calibrate(
        robot, data, pisigma.CalibrationSettings(model="geometric", folds=2, repeats=1)
    )
    figures = calibration.to_json()["cross_validation"]
    assert isinstance(figures, dict)
    assert figures["geometric"]["rms_mm"] < 0.02 < figures["nominal"]["rms_mm"]
    assert figures["geometric"]["rms_deg"] < 0.002 < figures["nominal"]["rms_deg"]
