"""A report draws the nominal and the calibrated arm over its images, and states zeros and errors."""

import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from testing.closeness import assert_close
from testing.phone_arm import BOARD, PHONE, arm_before_phone, phone_rows, rows_of_phone

import pisigma
from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.reporting.page.content import report_content
from pisigma.reporting.page.wording import arm_sentence
from pisigma.validation.report.arm_in_images import arm_in_images
from pisigma.workflow.report import report

IDENTIFIABLE = slice(1, 4)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("phone")
    rows, true, _ = phone_rows(0, 40)
    calibration = pisigma.calibrate("so101", rows, pisigma.CalibrationSettings(model="geometric", folds=0))
    calibration.save(folder / "model")
    (folder / "phone.yaml").write_text(PHONE.to_yaml())
    (folder / "board.yaml").write_text(
        "kind: charuco\nrows: 4\ncolumns: 6\nsquare_mm: 18\nmarker_mm: 13\ndictionary: 4x4_50\n"
    )
    (folder / "images").mkdir()
    for name in rows.image[:8]:
        Image.new("L", (PHONE.width, PHONE.height), 128).save(folder / "images" / f"{name}.png")
    cameras = CameraFiles((str(folder / "phone.yaml"),), (str(folder / "board.yaml"),), is_fixed=True)
    return calibration.model, rows, true, cameras, folder


def test_predictions_are_those_of_both_arms(arm):
    model, rows, _, cameras, folder = arm
    files = tuple(sorted((folder / "images").iterdir()))
    found = arm_in_images(model, rows, cameras, files)
    assert {one.name for one in found.images} == {file.stem for file in files}
    assert found.nominal_rms > 2 * found.calibrated_rms
    assert found.error_halvings == pytest.approx(math.log2(found.nominal_rms / found.calibrated_rms))
    for one in found.images:
        assert one.measured_corners.shape == (len(BOARD.corners), 2)
        # corner 0 is the origin of the tool, at which the links end
        for predicted in (one.nominal, one.calibrated):
            assert_close(predicted.frame_pixels[-1], predicted.corner_pixels[0], atol=1e-6)
        off = [
            np.linalg.norm(those.corner_pixels - one.measured_corners, axis=1)
            for those in (one.nominal, one.calibrated)
        ]
        assert off[1].max() < 40


def test_images_of_the_fit_are_counted(arm):
    model, rows, true, cameras, folder = arm
    files = tuple(sorted((folder / "images").iterdir()))
    fitted = arm_in_images(model, rows, cameras, files)
    assert fitted.to_json()["training_images"] == fitted.training_images == len(files)
    _, q, random = arm_before_phone(0)
    later = arm_in_images(model, rows_of_phone(true, q[40:80], random, 1), cameras, files)
    assert later.training_images == 0
    assert later.calibrated_rms > fitted.calibrated_rms / 2
    half = replace(fitted, training_images=len(files) // 2)
    remark = "fitted to"
    assert [remark in arm_sentence(one) for one in (fitted, half, later)] == [True, True, False]


def test_page_states_zeros_and_errors(arm):
    model, rows, true, cameras, folder = arm
    result = report(folder / "model", rows, cameras=cameras, images=[folder / "images"])
    values = result.to_json()["images"]
    zeros = [one for one in values["zeros"] if one["standard_error_deg"] is not None]
    real = np.rad2deg(true.dh - model.robot.dh)[IDENTIFIABLE, 0]
    assert_close([one["error_deg"] for one in zeros], real, atol=0.4)
    page = folder / "report.html"
    result.save(page)
    text = page.read_text()
    for one in zeros:
        assert f"{one['error_deg']:+.2f}" in text
    assert f"{values['calibrated_rms_mm']:.3g} mm" in text
    assert text.count('class="photo"') == 6


def test_images_need_their_corners(arm):
    _, rows, _, cameras, folder = arm
    with pytest.raises(MeasurementError) as error:
        report(folder / "model", cameras=cameras, images=[folder / "images"])
    assert error.value.option == "--images"
    (folder / "other").mkdir()
    Image.new("L", (64, 48)).save(folder / "other" / "other.png")
    with pytest.raises(MeasurementError) as error:
        report(folder / "model", rows, cameras=cameras, images=[folder / "other"])
    assert error.value.column == "image"


def test_images_measure_orientations(arm, tmp_path):
    model, *_ = arm
    assert not any(
        "Orientations were not measured" in line for line in report_content(model, tmp_path).advice
    )
