"""`training/README.md` is generated from the stored results, with every table of the papers."""

import json
import os
import re
import shutil
import subprocess
import sys

import pytest
import yaml
from testing.refusals import refused

from command import main
from markdown_text import FIGURES, command_of, link_to, plain, scientific
from page import PAGE, page_text
from pisigma.files.errors import RecipeError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from published import read_published
from recipe_runs import run_recipe
from stored_results import read_results, result_text

TABLES = {"jeong1998": 2, "park2022": 10, "jigs": 10}
PICTURES = {"jeong1998": 8, "park2022": 11, "jigs": 6}
"""Numbers of tables and figures of the papers."""
MAX_BYTES = 150_000
"""Maximum size of a picture [bytes]."""


@pytest.fixture(scope="module")
def training(repository):
    return repository / "training"


@pytest.fixture(scope="module")
def page(training) -> str:
    return (training / PAGE).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def remade(training, tmp_path_factory):
    """The folder of the recipes without its page and pictures, and these made again."""
    folder = tmp_path_factory.mktemp("papers") / "training"
    shutil.copytree(training, folder, ignore=shutil.ignore_patterns(PAGE, FIGURES))
    assert main(["--folder", str(folder)]) == 0
    return folder


def test_the_page_is_made_of_the_stored_results_byte_for_byte(training, remade):
    assert (remade / PAGE).read_bytes() == (training / PAGE).read_bytes()


def test_the_pictures_are_those_that_the_page_shows(training, remade, page):
    shown = set(re.findall(rf"\]\({FIGURES}/([\w.]+)\)", page))
    assert len(shown) >= 7
    for folder in (training, remade):
        assert {path.name for path in (folder / FIGURES).iterdir()} == shown
        for path in (folder / FIGURES).iterdir():
            assert path.read_bytes().startswith(b"\x89PNG")
            assert 5_000 < path.stat().st_size < MAX_BYTES, path.name


def test_every_recipe_has_a_stored_result_and_a_part_of_the_page(training, page):
    recipes = {path.stem for path in training.glob("*.yaml")} | {"jigs"}
    assert set(read_results(training).by_name) == recipes
    assert set(read_published(training).notes) == recipes
    for name in recipes:
        assert page.count(command_of(name)) >= 2  # in the overview, and above its figures


def _sections(page: str) -> dict[str, str]:
    parts = re.split(r"^#{2,3} (.+)$", page, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def _named(text: str, what: str) -> set[int]:
    """Numbers of the tables or figures that a text names: "Table 3", "Figs 4 and 6", "Tables 3 to 7"."""
    found: set[int] = set()
    for first, joint, last in re.findall(rf"{what}s?\.? (\d+)(?: (to|and) (\d+))?", text):
        found |= (
            set(range(int(first), int(last) + 1)) if joint == "to" else {int(n) for n in (first, last) if n}
        )
    return found


@pytest.mark.parametrize("key", TABLES)
def test_every_table_and_figure_of_the_papers_is_shown_or_its_absence_explained(training, page, key):
    paper, sections = read_published(training).paper(key), _sections(page)
    for items, count in ((paper.tables, TABLES[key]), (paper.figures, PICTURES[key])):
        assert [item.number for item in items] == list(range(1, count + 1))
    index = sections[paper.heading]
    for what, items in (("Table", paper.tables), ("Fig", paper.figures)):
        for item in items:
            assert f"| {item.number} | {item.shows} |" in index
            if item.section is None:
                assert f"not reproduced: {item.absent}" in index
            elif what == "Table":
                assert item.number in _named(sections[item.section], what), (key, item)
    assert all(item.absent is None for item in paper.tables)
    for sentence in paper.differences:
        assert f"- {sentence}" in sections[paper.heading.split(": ")[1]]


def test_links_within_the_page_lead_somewhere(page):
    headings = re.findall(r"^#+ (.+)$", page, flags=re.MULTILINE)
    assert len(headings) == len(set(headings))
    links = set(re.findall(r"\[[^\]]+\]\(#[^)]+\)", page))
    assert len(links) > 15
    assert links <= {link_to(heading) for heading in headings}


def test_published_figures_are_those_of_the_reference(training, shared_data):
    """The reference tables are transcriptions of their own."""
    path = shared_data.parent / "reference" / "redundancy.yaml"
    if not path.is_file():
        pytest.skip(f"reference figures not found in {path.parent}")
    reference, published = yaml.safe_load(path.read_text()), read_published(training)
    for robot, number in (("rb5", 7), ("panda", 8)):
        table, stated = (
            published.convergence[robot],
            reference[robot][f"table_{number}_rmse_mm_no_elimination"],
        )
        for iteration, value in stated.items():
            assert table.rmse_mm[table.iterations.index(iteration)][-1] == float(value)
        for column in ("alpha_deg", "a_mm", "d_mm"):
            assert list(getattr(published.dh_tables[robot], column)) == reference[robot][column]
        pairs = {
            (a, b, sign)
            for triangle in (published.correlations[robot].lengths, published.correlations[robot].angles)
            for row, a in enumerate(triangle.names)
            for b, value in zip(triangle.names, triangle.lower[row][:row], strict=False)
            if value is not None and abs(value) == 1
            for sign in [int(value)]
        }
        expected = set()
        for members in reference[robot]["redundant_sets"]:
            for later in range(1, len(members)):
                for earlier in range(later):
                    sign = -1 if members[later].startswith("-") else 1
                    expected.add((members[later].removeprefix("-"), members[earlier], sign))
        assert pairs == expected
        without = [
            n
            for n, row in zip(triangle_names(published, robot), diagonals(published, robot), strict=True)
            if row is None
        ]
        assert sorted(without) == sorted(reference[robot]["no_effect_on_position"])


def triangle_names(published, robot):
    return published.correlations[robot].angles.names


def diagonals(published, robot):
    return [row[-1] for row in published.correlations[robot].angles.lower]


def test_results_are_stored_so_that_lines_stay_short():
    result = {"a": 1, "list": [1.5, None], "rows": [{"b": []}, {}], "text": 'with "quotes"'}
    text = result_text(result)
    assert text.endswith("\n}\n")
    assert '\n "list": [1.5, null],\n' in text
    assert json.loads(text) == result
    with pytest.raises(ValueError, match="JSON"):  # the message is that of the json module
        result_text({"a": float("nan")})


def test_numbers_are_short():
    assert [scientific(value) for value in (0.0, 13.2, 4.53e-7, 1234.0)] == [
        "0.000",
        "13.200",
        "4.53e-07",
        "1.23e+03",
    ]
    assert [plain(value) for value in (110.7, 0.0, -30.0)] == ["110.7", "0", "-30"]


def test_a_missing_or_broken_result_is_named(training, tmp_path, capsys):
    folder = tmp_path / "training"
    shutil.copytree(training, folder, ignore=shutil.ignore_patterns(PAGE, FIGURES))
    (folder / "results" / "kiro3.json").unlink()
    with refused(RecipeError, file="kiro3.json") as missing:
        page_text(folder)
    assert missing.value.remedy.endswith(" run kiro3`")
    (folder / "results" / "kiro3.json").write_text("[]")
    assert main(["--folder", str(folder)]) == 2
    assert str(folder / "results" / "kiro3.json") in capsys.readouterr().err
    assert not (folder / PAGE).exists()


def test_a_recipe_that_does_not_run_leaves_no_result(tmp_path):
    with refused(RecipeError, file="none.yaml"):
        run_recipe(tmp_path, "none", None, tmp_path / "model")
    assert not list(tmp_path.iterdir())


def test_the_simulated_touches_are_a_measurement_file(repository, tmp_path, capsys):
    assert main(["touches", "--out", str(tmp_path / "touches.csv")]) == 0
    assert "192" in capsys.readouterr().out
    rows = Measurements.read_csv(tmp_path / "touches.csv", Robot.load("welding"))
    assert set(rows.frame) == {"jig_1", "jig_2"}
    assert set(rows.touch_axis) == {"x", "y", "z"}


def test_the_folder_runs_as_a_script(repository, tmp_path):
    command = [sys.executable, str(repository / "training" / "papers"), "--folder", str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(repository)}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 2
    assert "published.yaml" in done.stderr
