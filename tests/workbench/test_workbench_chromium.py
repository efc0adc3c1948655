"""A cell in headless Chromium: from an empty folder to a corrected pose by clicks and keys, as by the commands."""

import math
from pathlib import Path

import pytest
from testing.models import no_type_checker
from testing.workbench_page import opened, show, upload_file

pytest.importorskip("viser", reason="the extra view is not installed")

from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.registry import export_model
from pisigma.deployment.export.targets import POSE_COLUMNS
from pisigma.lifetime.cell.layout import MODELS, PLANS, SESSIONS
from pisigma.measurement.dataset import Measurements
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import xyz_zyx_from_transform
from pisigma.workbench.workbench import Workbench
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.load import load

SETTINGS = (("plan", "candidates", "100"), ("calibrate", "model", "geometric"), ("calibrate", "folds", "0"))


@pytest.fixture(scope="module")
def simulated(shared_data) -> Path:
    """The folder of simulated arms."""
    folder = shared_data.parent / "simulated"
    if not folder.is_dir():
        pytest.skip(f"simulated arms not found in {folder}")
    return folder


def created(page, folder: Path, robot: Path) -> Cell:
    """Create the cell of an empty folder by its form."""
    page.set_input_files("[data-links]", robot)
    page.select_option("[name=tip]", label="tool0")
    page.press("form[data-step=new] button[type=submit]", "Enter")
    page.wait_for_selector("#tab-cell")
    return Cell.open(folder)


def set_in_form(page, cell: Cell) -> None:
    """Change settings by the form of `cell.yaml`; the first value is not valid."""
    show(page, "cell")
    comments = [line for line in cell.file.path.read_text().splitlines() if "#" in line]
    for section in ("plan", "calibrate"):
        page.click(f"summary >> text=/^{section}$/")
    for value, is_refused in (("many", True), ("150", False), ("120", False), ("100", False)):
        page.fill("[name='plan.candidates']", value)
        press(page, "cell")
        assert bool(page.query_selector("[name='plan.candidates'][aria-invalid]")) is is_refused
        assert bool(page.query_selector("label:has([name='plan.candidates']) .fault")) is is_refused
    page.fill("[name='plan.candidates']", "200")
    page.reload()
    assert page.wait_for_selector("[name='plan.candidates']").input_value() == "200"
    page.click("summary >> text=/^calibrate$/")
    show(page, "plan")
    show(page, "cell")
    do(page, "cell", **{f"{section}.{key}": value for section, key, value in SETTINGS})
    lines = cell.file.path.read_text().splitlines()
    assert [line for line in lines if "#" in line] == comments


def set_in_text(cell: Cell) -> None:
    """Change the same settings in the text."""
    text = cell.file.path.read_text()
    for _, key, value in SETTINGS:
        text = text.replace(f"\n  # {key}:", f"\n  {key}: {value}\n  # {key}:", 1)
    cell.file.path.write_text(text)


def press(page, step) -> None:
    """Press the button of a form with a key, and wait for the end."""
    before = int(page.get_attribute("body", "data-ended"))
    page.press(f"form[data-step={step}] button[type=submit]", "Enter")
    page.wait_for_selector(f"body[data-ended='{before + 1}']", timeout=60_000)


def do(page, step, **fields):
    """Fill a form, press its button with a key and wait for the end; return what the page says."""
    for name, value in fields.items():
        page.fill(f"form[data-step={step}] [name='{name}']", value)
    press(page, step)
    assert page.query_selector(".refusal") is None, page.inner_text(".refusal")
    return page.inner_text("#content")


def upload(page, path):
    """Upload rows and add them to the cell."""
    show(page, "measure")
    upload_file(page, path)
    return do(page, "import")


def rows_of(path: Path, target: Path, count: int) -> Path:
    """Write the first rows of a file."""
    target.write_text("".join(path.read_text().splitlines(keepends=True)[: 1 + count]))
    return target


def test_from_an_empty_folder_to_a_corrected_pose(browser, simulated, tmp_path, blank_pictures):
    folder, robot = tmp_path / "page", simulated / "kr10.urdf"
    first = rows_of(simulated / "kr10.csv", tmp_path / "2026-11-01.csv", 60)
    second = rows_of(simulated / "kr10_check.csv", tmp_path / "2026-11-02.csv", 20)
    with no_type_checker(), Workbench(folder, port=0) as bench, opened(browser, bench.url) as page:
        page_cell = created(page, folder, robot)
        command_cell = Cell.create(tmp_path / "commands", robot, tip="tool0")
        assert page_cell.file.path.read_bytes() == command_cell.file.path.read_bytes()
        set_in_form(page, page_cell)
        set_in_text(command_cell)
        assert page_cell.file.path.read_bytes() == command_cell.file.path.read_bytes()
        show(page, "plan")
        assert "pisigma plan" in do(page, "plan", count="12", check="2")
        assert "60 rows were added" in upload(page, first)
        show(page, "calibrate")
        assert "Accuracy" in do(page, "calibrate")
        upload(page, second)
        show(page, "verify")
        assert "is in use" in do(page, "verify")
        page_cell, command_cell = Cell.open(folder), Cell.open(command_cell.folder)
        command_cell.plan(count=12, check=2)
        for rows in (first, second):
            command_cell.add_session(rows)
            if rows is first:
                command_cell.calibrate()
        command_cell.verify()
        (model,) = (page_cell.folder / MODELS).iterdir()
        for name in (
            f"{PLANS}/{model.name}.csv",
            f"{SESSIONS}/2026-11-02.csv",
            f"{MODELS}/{model.name}/model.yaml",
        ):
            assert (page_cell.folder / name).read_bytes() == (command_cell.folder / name).read_bytes(), name

        pose = reachable_pose(page_cell, first)
        show(page, "deliver")
        assert "reaches the pose" in do(page, "ik", **pose)
        (tmp_path / "poses.csv").write_text(f"{','.join(pose)}\n{','.join(pose.values())}\n")
        page.select_option("[name=format]", "targets")
        page.set_input_files("[data-upload=poses]", tmp_path / "poses.csv")
        do(page, "export", out="job.src")
        with page.expect_download() as started:
            page.click(".files a >> text=job.src")
        written = export(command_cell, tmp_path / "poses.csv", tmp_path / "job.src")
        assert Path(started.value.path()).read_bytes() == written.read_bytes()


def reachable_pose(cell: Cell, rows: Path) -> dict[str, str]:
    """Return the first pose of some rows that the model reaches, by the names of the fields."""
    q = Measurements.read_csv(rows, cell.robot).q
    T = forward_kinematics(cell.model.robot, q)
    (reached, *_) = (load(cell.folder)(T).status == Status.REACHED).nonzero()[:, 0].tolist()
    x, y, z, *angles = xyz_zyx_from_transform(T[reached]).tolist()
    values = (1e3 * x, 1e3 * y, 1e3 * z, *map(math.degrees, angles))
    return dict(zip(POSE_COLUMNS, map(repr, values), strict=True))


def export(cell: Cell, poses: Path, out: Path) -> Path:
    """Export a program as the command does."""
    export_model("targets", ExportRequest(cell.model_folder(), out, poses=poses))
    return out
