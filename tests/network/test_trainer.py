"""The checkpoints of a training: made, refused, removed."""

import pytest

from pisigma.files.errors import OutputError, TrainingError
from pisigma.network.trainer import Checkpoints


def test_resuming_nothing_or_something_else_is_refused(tmp_path):
    with pytest.raises(TrainingError, match="no interrupted training to resume; run without --resume"):
        Checkpoints(tmp_path, "a", resume=True).prepare()
    (tmp_path / "last.ckpt").write_bytes(b"no checkpoint")
    with pytest.raises(TrainingError, match="no whole checkpoint"):
        Checkpoints(tmp_path, "a", resume=True).prepare()


def test_a_folder_that_cannot_be_made_is_refused_and_old_checkpoints_go(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        Checkpoints(tmp_path / "file" / "checkpoints", "a").prepare()
    (tmp_path / "last.ckpt").write_text("")
    (tmp_path / "mine.txt").write_text("")
    Checkpoints(tmp_path, "a").prepare()
    assert [entry.name for entry in sorted(tmp_path.iterdir())] == ["file", "mine.txt"]
