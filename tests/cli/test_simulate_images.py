"""`pisigma simulate --images` writes what `pisigma detect` reads."""

import json
from pathlib import Path

from testing.closeness import assert_close
from testing.refusals import problem_of

from pisigma.files.errors import RecipeError
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera


def test_images_of_a_recipe_are_written_with_what_a_cell_states(run, tmp_path: Path, repository: Path):
    text = (repository / "training" / "ur5_camera.yaml").read_text()
    for old, new in (("count: 50", "count: 2"), ("width: 1920, height: 1200", "width: 480, height: 300")):
        text = text.replace(old, new)
    text = text.replace("fx: 1400, fy: 1400, cx: 960, cy: 600", "fx: 350, fy: 350, cx: 240, cy: 150")
    (tmp_path / "recipe.yaml").write_text(text)
    cell = tmp_path / "cell"
    printed = json.loads(run("simulate", tmp_path / "recipe.yaml", "--images", cell, "--json").stdout)
    assert printed == {"folder": str(cell), "images": 2}
    assert sorted(path.name for path in cell.glob("*.png")) == ["0000.png", "0001.png"]
    camera, board = Camera.load(cell / "camera.yaml"), Board.load(cell / "board.yaml")
    assert (camera.name, camera.width, board.rows, board.columns) == ("wrist", 480, 6, 9)
    assert_close(board.square, 0.03)
    header, *rows = (cell / "joints.csv").read_text().splitlines()
    assert header == "image,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg"
    assert [row.split(",")[0] for row in rows] == ["0000.png", "0001.png"]


def test_a_recipe_with_a_tracker_has_no_images(run, tmp_path: Path, repository: Path):
    result = run("simulate", repository / "training" / "kiro3.yaml", "--images", tmp_path / "cell")
    assert result.exit_code == 2
    assert isinstance(problem_of(result), RecipeError)
    result = run("simulate", repository / "training" / "kiro3.yaml")
    assert result.exit_code == 2
    assert "--images" in result.stderr
