"""Exports whose poses or joint values depend on the target say for which of several they are."""

from pathlib import Path

import pytest

from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.registry import BUILT_IN, export_model
from pisigma.model.folder.model_folder import load_model
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot.se3 import xyz_zyx_from_transform

FILES = {
    "dh": ("dh.csv",),
    "urdf": ("arm.urdf",),
    "mjcf": ("arm.xml",),
    "library": ("library",),
    "onnx": ("correction.onnx",),
    "rsi": ("rsi.xml",),
    "targets": ("targets.csv", "targets.src"),
}
OF_ZEROS = {"offsets", "epson", "fanuc-mastering", "lerobot"}
"""Formats of joint zeros, which are those of all targets."""
OF_OTHER_ROBOTS = {"ur-calibration", "ur-ros", "staubli", "xacro"}
"""Formats of other robots, and of a file to be changed, which share the remarks of `ControllerFile`."""


def test_every_format_is_here() -> None:
    assert {*FILES, *OF_ZEROS, *OF_OTHER_ROBOTS} == set(BUILT_IN)


@pytest.mark.parametrize(("form", "name"), [(form, name) for form, names in FILES.items() for name in names])
def test_the_target_is_named(form: str, name: str, repository: Path, tmp_path: Path) -> None:
    folder, poses = repository / "models" / "fanuc_burakov", None
    if form == "targets":
        model = load_model(folder)
        x, y, z, *angles = xyz_zyx_from_transform(CorrectedIK(model).forward(model.starts[:1]))[0].tolist()
        values = [1e3 * x, 1e3 * y, 1e3 * z, *(180 / 3.141592653589793 * angle for angle in angles)]
        poses = tmp_path / "poses.csv"
        poses.write_text(f"x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n{','.join(map(str, values))}\n")
    exported = export_model(form, ExportRequest(folder, tmp_path / name, poses=poses))
    assert any("'A'" in remark and "(A, B, C)" in remark for remark in exported.remarks)
    if name == "targets.src":
        assert "(A, B, C)" in (tmp_path / name).read_text()
