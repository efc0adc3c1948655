"""A recalibration that is killed while it writes its model: a small case of `chain_kills.py`."""

from hostile.chain_kills import Chain


def test_a_killed_recalibration_leaves_a_complete_model_or_none(tmp_path):
    chain = Chain(tmp_path)
    process = chain.start(0, monitor=False)
    chain.wait_for_writing(process)
    process.kill()
    process.wait()
    assert not chain.fault()
    assert chain.links == 1 + (tmp_path / "link-1").exists()
