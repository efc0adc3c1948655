"""Checkpoints of a training are created, checked and removed."""

from testing.refusals import refused

from pisigma.files.errors import OutputError, TrainingError
from pisigma.network.trainer import Checkpoints


def test_resuming_without_a_valid_checkpoint_is_rejected(tmp_path):
    with refused(TrainingError, file=tmp_path, expected="an interrupted training"):
        Checkpoints(tmp_path, "a", resume=True).prepare()
    (tmp_path / "last.ckpt").write_bytes(b"no checkpoint")
    with refused(TrainingError, file="last.ckpt", expected="a complete checkpoint of pisigma"):
        Checkpoints(tmp_path, "a", resume=True).prepare()


def test_an_unwritable_folder_is_rejected_and_old_checkpoints_are_removed(tmp_path):
    (tmp_path / "file").write_text("")
    with refused(OutputError, file="checkpoints", value="Not a directory"):
        Checkpoints(tmp_path / "file" / "checkpoints", "a").prepare()
    (tmp_path / "last.ckpt").write_text("")
    (tmp_path / "mine.txt").write_text("")
    Checkpoints(tmp_path, "a").prepare()
    assert [entry.name for entry in sorted(tmp_path.iterdir())] == ["file", "mine.txt"]
