"""Videos: the sharpest frame of every stop, by number or by time."""

import struct
from pathlib import Path

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.workflow.images.detect import join_joint_values

cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is not installed")

from pisigma.measurement.camera.detection.detector import image_files, read_image  # noqa: E402
from pisigma.measurement.camera.detection.video import still_frames  # noqa: E402
from pisigma.workflow.images.detect import detect  # noqa: E402

RATE, STOP, MOVE, STOPS = 20, 14, 8, 3
SHARP = 9
"""The only sharp frame of every stop."""


def frame(number: int, rng: np.random.Generator) -> np.ndarray:
    """A pattern that rests, moves by 3 px per frame, and rests again; with noise."""
    stop, k = divmod(number, STOP + MOVE)
    x = 20 + stop * 3 * MOVE + 3 * max(k - STOP, 0)
    image = np.full((120, 160), 120.0)
    for row, column in np.ndindex(4, 4):
        image[30 + 10 * row : 40 + 10 * row, x + 10 * column : x + 10 + 10 * column] = 220 * (
            (row + column) % 2
        )
    if k != SHARP:
        image = cv2.GaussianBlur(image, (0, 0), 0.6)
    return np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, rng = tmp_path_factory.mktemp("video") / "poses.avi", np.random.default_rng(0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE, (160, 120))
    for number in range(STOPS * STOP + (STOPS - 1) * MOVE):
        writer.write(cv2.cvtColor(frame(number, rng), cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def test_the_sharpest_frame_of_every_stop_is_chosen(video):
    frames = still_frames(video)
    expected = [stop * (STOP + MOVE) + SHARP for stop in range(STOPS)]
    assert [one.number for one in frames] == expected
    assert_close([one.time for one in frames], np.array(expected) / RATE, atol=1e-3)


def test_frames_are_read_like_image_files(video):
    files = image_files([video])
    assert [file.stem for file in files] == ["0001", "0002", "0003"]
    for file, still in zip(files, still_frames(video), strict=True):
        expected = frame(still.number, np.random.default_rng(1))
        assert np.abs(read_image(file).astype(float) - expected).mean() < 5
    assert [file.stem for file in image_files([video], 100.0)] == ["100.450", "101.550", "102.650"]


def test_frames_of_several_videos_are_not_named_by_one_start(video, tmp_path):
    second = tmp_path / "second.avi"
    second.write_bytes(video.read_bytes())
    with refused(MeasurementError, file=str(second), value=2):
        image_files([video, second], 100.0)


def test_times_are_joined_only_to_a_video_with_a_start(video, tmp_path):
    joints = tmp_path / "joints.csv"
    joints.write_text("time,q1_deg\n0,0\n1,1\n2,2\n")
    with refused(MeasurementError, file=str(video), value="none"):
        detect([video], tmp_path / "board.yaml", tmp_path / "camera.yaml", joints)


def test_stops_are_paired_only_if_every_row_is_one(video, tmp_path):
    log = tmp_path / "joints.csv"
    log.write_text("image,q1_deg\n1,10\n2,20\n3,30\n")
    names = [file.stem for file in image_files([video])]
    assert join_joint_values(names, log, 0.2, len(names)).texts_by_image == {
        "0001": ("10",),
        "0002": ("20",),
        "0003": ("30",),
    }
    log.write_text("image,q1_deg\n1,10\n2,20\n")
    with refused(MeasurementError, value=3):
        join_joint_values(names, log, 0.2, len(names))


def test_files_without_stops_are_refused(tmp_path):
    (tmp_path / "text.mp4").write_text("no video")
    with refused(MeasurementError, value=None):
        still_frames(tmp_path / "text.mp4")
    with refused(MeasurementError):
        still_frames(tmp_path / "missing.mp4")


def with_two_rates(content: bytes, first: int) -> bytes:
    """Return an MP4 file in which frames from number `first` on last twice as long (ISO/IEC 14496-12, 8.6.1.2)."""
    here = content.index(b"stts") - 4
    count, duration = struct.unpack(">II", content[here + 16 : here + 24])
    entries = struct.pack(">IIIII", 2, first, duration, count - first, 2 * duration)
    new = bytearray(content[:here] + struct.pack(">I4sI", 32, b"stts", 0) + entries + content[here + 24 :])
    for box in (
        b"moov",
        b"trak",
        b"mdia",
        b"minf",
        b"stbl",
    ):  # they contain the table, which is 8 bytes longer now
        at = content.index(box) - 4
        new[at : at + 4] = struct.pack(">I", struct.unpack(">I", content[at : at + 4])[0] + 8)
    return bytes(new)


def test_frames_of_a_variable_rate_are_read_by_their_number(tmp_path):
    path = tmp_path / "steady.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), RATE, (160, 120))
    for number in range(80):
        writer.write(np.full((120, 160, 3), 3 * number, np.uint8))
    writer.release()
    changed = tmp_path / "changed.mp4"
    changed.write_bytes(with_two_rates(path.read_bytes(), 40))
    read = [read_image(changed / f"pose.frame{number}").mean() / 3 for number in (10, 55, 50)]
    assert_close(read, np.array([10, 55, 50]), atol=1.0)
