"""The gallery: every example runs, improves what it shows, and is on the page; marked snippets of all pages run."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image
from testing.forked import Programs, programs

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
MARK = "<!-- runs -->"
PAGES = [page for page in sorted((ROOT / "docs").rglob("*.md")) if MARK in page.read_text(encoding="utf-8")]
MAX_LINES = 60


@pytest.fixture(scope="module")
def running() -> Iterator[Programs]:
    with programs() as started:
        yield started


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_writes_its_picture(running, example, tmp_path):
    assert len(example.read_text(encoding="utf-8").splitlines()) <= MAX_LINES
    done = running.run(example, tmp_path)
    assert done.returncode == 0, done.stderr
    picture = f"{example.stem}.png"
    for folder in (tmp_path, ROOT / "docs" / "figures" / "gallery"):
        with Image.open(folder / picture) as image:
            assert image.size == (400, 300)
    errors = [float(number) for number in re.findall(r"([0-9.]+) mm (?:RMS|from)", done.stdout)]
    if example.stem == "touch_jig":
        errors = [float(number) for number in re.findall(r"[0-9]+[.][0-9]+", done.stdout)]
    if example.stem == "own_feature":
        assert "(belt)" in done.stdout
    else:
        assert errors[-1] < errors[0] / 4


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_the_marked_snippets_of_a_page_run(running, page, tmp_path):
    """Run all snippets of a page together, as a reader does."""
    text, program = page.read_text(encoding="utf-8"), tmp_path / "snippets.py"
    blocks = re.findall(rf"{MARK}\n+```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    assert len(blocks) == text.count(MARK)
    (tmp_path / "models").symlink_to(ROOT / "models")
    program.write_text("\n".join(blocks), encoding="utf-8")
    done = running.run(program, tmp_path)
    assert done.returncode == 0, done.stderr


def test_the_page_and_the_first_page_show_every_example():
    page, first = ((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("gallery.md", "index.md"))
    names = {path.stem for path in EXAMPLES}
    assert len(names) == 12
    assert set(re.findall(r'^--8<-- "examples/(\w+)[.]py"$', page, re.M)) == names
    assert set(re.findall(r"figures/gallery/(\w+)[.]png", first)) == names
