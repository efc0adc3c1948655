"""Every block of README and docs runs in `python tests/gate/run.py docs`, or has a reason why it does not."""

from gate.docs import AT, BEFORE, NOT_HERE, STATUS, blocks, reason_not_to_run

LINES = [line for block in blocks("bash") for line in block.lines]


def test_every_line_runs_or_has_a_reason():
    runs = [line for line in LINES if not reason_not_to_run(line)]
    assert {line.split()[0] for line in runs} == {"pisigma", "sha256sum"}
    assert len(runs) > 100
    assert [line for line in runs if " ... " in line] == []


def test_exceptions_apply_to_existing_lines_and_blocks():
    texts = [block.text for block in blocks("bash", "python")]
    for begin in (*NOT_HERE, *STATUS):
        assert any(line.startswith(begin) for line in LINES), begin
    for begin in (*AT, *BEFORE):
        assert any(text.startswith(begin) for text in texts), begin
