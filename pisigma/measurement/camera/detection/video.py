"""Sharp frames from videos of an arm that stops at every pose."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import label, median_filter

from pisigma.files.errors import MeasurementError, Place
from pisigma.files.input_file import read_input
from pisigma.measurement.camera.detection.detected_board import Image

_ENDINGS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
"""File name extensions of videos."""
FRAME = ".frame"
"""Beginning of the extension of a frame's path, such as VIDEO.mp4/0003.frame182."""
_BLOCKS = (16, 12)
"""Number of blocks of an image along u and v; a change in any block shows that the arm is moving."""
_BLOCK_PIXELS = 24
"""Width and height of a block after the reduction of the image [px]."""
LAG = 0.1
"""Time between frames that are compared [s]; slow motions change neighbouring frames too little."""
_MIN_STILL = 0.4
"""Shortest duration of a stop [s]."""
_NOISE_SHARE, _NOISE_FACTOR, _NOISE_GRAY = 0.2, 1.5, 2.0
"""Criteria of a motion: the change of frames at rest is the first quantile of all changes, and larger changes are
motions if they exceed it by the second factor and by the third number of gray levels."""


@dataclass(frozen=True)
class StillFrame:
    """The sharpest frame of a stop.

    Attributes:
        number: number of the frame, from 0.
        time: time of the frame from the start of the video [s].
    """

    number: int
    time: float


def still_frames(path: str | os.PathLike[str]) -> tuple[StillFrame, ...]:
    """Return the sharpest frame of every stop in a video, by the variance of the Laplacian (Pech-Pacheco et al. 2000).

    A stop is an interval of 0.4 s or more in which no block of the image changes by more than the noise.

    Raises:
        MeasurementError: the file is not a video that OpenCV reads, or contains no stop.
    """
    frames = list(_changes(path))
    times, changes, sharpness = np.array(frames).T
    changes = median_filter(changes, 3)
    runs, count = label(_is_still(changes))
    stops = list[StillFrame]()
    for run in range(1, count + 1):
        chosen = np.flatnonzero(runs == run)
        if times[chosen[-1]] - times[chosen[0]] + LAG >= _MIN_STILL:
            best = int(chosen[sharpness[chosen].argmax()])
            stops.append(StillFrame(best, float(times[best])))
    if not stops:
        raise MeasurementError(
            f"the arm never rests for {_MIN_STILL:g} s or more in the video",
            expected=f"an arm that rests for {_MIN_STILL:g} s or more at every pose",
            at=Place(path),
            remedy="let it rest for a second at every pose, and mount the phone rigidly",
        )
    return tuple(stops)


def is_video(path: Path) -> bool:
    """Return whether a file is a video, by its extension."""
    return path.suffix.lower() in _ENDINGS


def frame_path(video: Path, frame: StillFrame, name: str) -> Path:
    """Return the path by which `read_frame` reads a frame, with the given name as its stem."""
    return video / f"{name}{FRAME}{frame.number}"


def is_frame(path: Path) -> bool:
    """Return whether a path is that of a frame of a video."""
    return path.suffix.startswith(FRAME) and is_video(path.parent)


def read_frame(path: Path) -> Image:
    """Return the gray values of a frame of a video; see `frame_path`.

    Raises:
        MeasurementError: the frame cannot be read.
    """
    video = path.parent
    with _LOCK:
        frame = _frame_reader(video, video.stat().st_mtime_ns).read(int(path.suffix.removeprefix(FRAME)))
    if frame is None:
        raise MeasurementError("the frame cannot be read", at=Place(path), remedy="copy the video again")
    return frame


class _FrameReader:
    """Reads frames by decoding all frames before them.

    OpenCV seeks with the mean frame rate and would return wrong frames of videos with a variable rate, as recorded by
    phones.
    """

    def __init__(self, path: Path) -> None:
        """Open a video.

        Raises:
            MeasurementError: the file cannot be read, or is not a video.
        """
        self._path, self._next = path, 0
        self._video = _open(path)

    def read(self, number: int) -> Image | None:
        """Return the gray values of a frame, or None if it cannot be decoded; ascending numbers need a single pass."""
        if number < self._next:
            self._video, self._next = _open(self._path), 0
        while self._next <= number:
            if not self._video.grab():
                return None
            self._next += 1
        is_read, frame = self._video.retrieve()
        return _gray(frame) if is_read else None


_LOCK = threading.Lock()
"""Lock that is held while a frame is read, because all threads share one reader."""


@lru_cache(maxsize=1)
def _frame_reader(path: Path, mtime_ns: int) -> _FrameReader:
    """Return the reader of a video, which is reused until another video is read or the file changes."""
    return _FrameReader(path)


def _is_still(changes: Float64[np.ndarray, " frames"]) -> Bool[np.ndarray, " frames"]:
    """Return whether the changes of frames are not larger than their noise."""
    noise = np.quantile(changes[np.isfinite(changes)], _NOISE_SHARE) if np.isfinite(changes).any() else 0.0
    still: np.ndarray = changes <= _NOISE_FACTOR * noise + _NOISE_GRAY
    return still


def _changes(path: str | os.PathLike[str]) -> Iterator[tuple[float, float, float]]:
    """Return time [s], largest change of a block since `LAG` (infinite at the start), and sharpness of every frame."""
    with _opened(path) as video:
        rate = video.get(cv2.CAP_PROP_FPS) or 30.0
        size, before, number = tuple(_BLOCK_PIXELS * n for n in _BLOCKS), list[np.ndarray](), 0
        lag = max(round(LAG * rate), 1)
        while (read := video.read())[0]:
            gray = _gray(read[1])
            small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
            change = np.inf
            if len(before) == lag:
                change = float(
                    cv2.resize(np.abs(small - before.pop(0)), _BLOCKS, interpolation=cv2.INTER_AREA).max()
                )
            before.append(small)
            time = video.get(cv2.CAP_PROP_POS_MSEC) / 1e3
            yield time if time > 0 else number / rate, change, float(cv2.Laplacian(gray, cv2.CV_32F).var())
            number += 1


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[cv2.VideoCapture]:
    """Open a video without rotating its frames, because the intrinsics are those of the sensor.

    Raises:
        MeasurementError: the file cannot be read, or is not a video.
    """
    video = _open(path)
    try:
        yield video
    finally:
        video.release()


def _open(path: str | os.PathLike[str]) -> cv2.VideoCapture:
    """Open a video (see `_opened`); it is closed when the last reference to it is dropped."""
    if not os.path.isfile(path):
        read_input(path, MeasurementError)
    video = cv2.VideoCapture(os.fspath(path))
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    if not video.isOpened() or video.get(cv2.CAP_PROP_FRAME_COUNT) < 1:
        video.release()
        raise MeasurementError(
            expected="a video that OpenCV reads", at=Place(path), remedy="convert it to MP4 (H.264)"
        )
    return video


def _gray(frame: np.ndarray) -> Image:
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) if frame.ndim == 3 else frame, dtype=np.uint8)
