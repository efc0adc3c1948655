"""A packed cell is the same cell elsewhere, and an archive that is not one writes nothing."""

import stat
import zipfile

import pytest
from testing.refusals import refused

from pisigma.files.errors import MeasurementError, OutputError, PlanningError
from pisigma.lifetime.cell.history import HISTORY
from pisigma.lifetime.cell.layout import CELL_FILE, newest_plan
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.transfer import pack, unpack


@pytest.fixture
def cell(tmp_path, repository):
    cell = Cell.create(tmp_path / "here" / "welder7", "ur10", limit_mm=0.3)
    cell.history.record("maintenance", "2026-01-10", "new gear")
    (cell.folder / "sessions" / "notes.txt").write_text("by hand")
    return cell


def files(folder):
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder): path.name == HISTORY or path.read_bytes() for path in paths}


def test_an_unpacked_cell_has_the_same_files(cell, tmp_path):
    count = pack(cell, tmp_path / "welder7.zip")
    other = unpack(tmp_path / "welder7.zip", tmp_path / "there" / "welder8")
    assert files(other.folder) == files(cell.folder)
    assert count == len(files(cell.folder))
    assert other.history.events() == cell.history.events()
    assert other.status().step.state == cell.status().step.state


@pytest.mark.parametrize("count", [2, 3, 4])
def test_the_newest_plan_is_the_same_in_a_copy(count, cell, tmp_path):
    plans = ["2026-10-30-11", "2026-11-01", "2026-11-01-2", "2026-11-01-10"][:count]
    for name in plans:
        (cell.folder / "plans" / f"{name}.csv").write_text("q1_deg\n")
    pack(cell, tmp_path / "welder7.zip")
    for folder in (cell.folder, unpack(tmp_path / "welder7.zip", tmp_path / "there").folder):
        assert newest_plan(folder).stem == plans[-1]


def test_a_cell_is_packed_without_the_changes_that_another_process_is_making(cell, tmp_path):
    with cell.history.database.transaction() as database:
        cell.history.database.insert(database, cell.history.events())
        assert cell.history.path.with_name(f"{HISTORY}-journal").exists()
        pack(cell, tmp_path / "welder7.zip")
    other = unpack(tmp_path / "welder7.zip", tmp_path / "there")
    assert [one.kind for one in other.history.events()] == ["maintenance"]
    assert not list(other.folder.glob("*-journal"))
    assert len(cell.history.events()) == 2


def archive(path, *members):
    with zipfile.ZipFile(path, "w") as written:
        written.writestr(CELL_FILE, "robot: ur10\n")
        for name, mode in members:
            info = zipfile.ZipInfo(name)
            info.external_attr = mode << 16
            written.writestr(info, "content")
    return path


@pytest.mark.parametrize(
    "member",
    [
        ("../outside.txt", 0),
        ("/etc/outside.txt", 0),
        ("sessions/../../outside.txt", 0),
        ("C:\\outside.txt", 0),
        ("link", stat.S_IFLNK | 0o777),
        ("pipe", stat.S_IFIFO | 0o644),
        ("CELL.yaml", 0),
    ],
)
def test_an_archive_that_leads_out_of_its_folder_is_refused_and_nothing_is_written(tmp_path, member):
    path = archive(tmp_path / "bad.zip", member)
    with refused(PlanningError, file="bad.zip"):
        unpack(path, tmp_path / "cell")
    assert sorted(tmp_path.iterdir()) == [path]


def test_an_archive_that_claims_too_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("pisigma.workflow.cell.transfer.MAX_BYTES", 10)
    with refused(PlanningError, file="big.zip"):
        unpack(archive(tmp_path / "big.zip"), tmp_path / "cell")


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 broken"])
def test_a_file_of_another_kind_is_refused(tmp_path, content):
    (tmp_path / "cell.zip").write_bytes(content)
    with refused(PlanningError, file="cell.zip"):
        unpack(tmp_path / "cell.zip", tmp_path / "cell")
    assert not (tmp_path / "cell").exists()


def test_a_missing_file_and_a_folder_that_exists_are_refused(cell, tmp_path):
    with refused(PlanningError, file="no.zip"):
        unpack(tmp_path / "no.zip", tmp_path / "cell")
    pack(cell, tmp_path / "cell.zip")
    with refused(OutputError, file=cell.folder):
        unpack(tmp_path / "cell.zip", cell.folder)


def test_a_cell_with_a_link_is_not_packed(cell, tmp_path):
    (cell.folder / "link").symlink_to("/etc/hostname")
    with refused(OutputError, file=cell.folder / "link"):
        pack(cell, tmp_path / "cell.zip")
    assert not (tmp_path / "cell.zip").exists()


def test_a_cell_with_an_edited_session_is_not_packed(cell, tmp_path, repository):
    from pisigma.lifetime.cell.history import SessionEntry

    cell.history.add(SessionEntry("gone", "abc", "2026-01-11T00:00:00+00:00", "2026-01-11", 5, "position"))
    with refused(MeasurementError):
        pack(cell, tmp_path / "cell.zip")


def test_a_damaged_file_is_refused_and_nothing_is_written(cell, tmp_path):
    pack(cell, tmp_path / "cell.zip")
    content = bytearray((tmp_path / "cell.zip").read_bytes())
    for place in range(60, len(content) // 2, 97):
        content[place] ^= 0xFF
    (tmp_path / "cell.zip").write_bytes(content)
    with refused(PlanningError, file="cell.zip"):
        unpack(tmp_path / "cell.zip", tmp_path / "other")
    assert not (tmp_path / "other").exists()
