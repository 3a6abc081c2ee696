"""Videos as captures: a fixed camera records an object while a lamp is moved around it.

Of the hundreds of frames, a few are enough if they are sharp, not overexposed, and under very
different lights.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.decoders import damage_as_input_error, native_stderr
from splinecli.capture.formats.images import check_stored_size
from splinecli.errors import InputError
from splinecli.maths import Float32Array
from splinecli.maths.normals import unit
from splinecli.maths.transfer import BT709, decode_transfer
from splinecli.system.files import check_file, is_folder, utf8_name

if TYPE_CHECKING:
    import cv2

MOST_FRAMES, FEWEST_FRAMES = 24, 6
_CANDIDATES = 1000  # most frames compared; longer videos are subsampled by 2, 4 and so on
# FFmpeg would also open playlists, which refer to other files, so only video containers are opened.
_CONTAINERS = re.compile(rb"....(ftyp|moov|mdat|wide)|RIFF|\x1a\x45\xdf\xa3", re.DOTALL)
# A frame's number, linear thumbnail, sharpness and share of clipped pixels
_Candidate = tuple[int, Float32Array, float, float]


def is_film(path: Path) -> bool:
    """Return whether the path has the suffix of a video and is not a folder."""
    suffixes = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm")
    return path.suffix.lower() in suffixes and path.stem.strip(".") != "" and not is_folder(path)


def choose_frames(film: Path) -> tuple[int, ...]:
    """Return the ascending zero-based numbers of the frames whose lights differ most.

    Between FEWEST_FRAMES and MOST_FRAMES frames are chosen. Raises InputError if the video cannot
    be read, or if its light does not move.
    """
    numbers, thumbnails, sharpness, clipped = map(np.array, zip(*_candidates(film), strict=True))
    light = thumbnails.mean(axis=1)
    # Sharpness also depends on the light, so only neighbouring frames are compared.
    around = [
        np.median(sharpness[max(0, place - 7) : place + 8]) for place in range(len(sharpness))
    ]
    bright = (light >= 0.2 * np.median(light)) & (light > 0)
    usable = (
        (sharpness >= 0.6 * np.array(around))
        & bright
        & (clipped <= max(0.01, float(np.median(clipped))))
    )
    chosen = _farthest(thumbnails[usable])
    if len(chosen) < FEWEST_FRAMES:
        raise InputError(
            f"only {len(chosen)} of {len(numbers)} frames are sharp and under different lights,"
            f" expected at least {FEWEST_FRAMES}",
            film,
            hint="Record from a tripod with focus and exposure locked, while you move the lamp all"
            " around the object",
        )
    return tuple(sorted(numbers[usable][chosen].tolist()))


def read_frames(film: Path, numbers: Iterable[int]) -> Iterator[NDArray[np.uint8]]:
    """Yield frames as stored, (H, W, 3) RGB, usually encoded with BT.709; the numbers must be
    ascending.

    Raises InputError.
    """
    with _opened(film) as video:
        place = 0
        for number in numbers:
            with native_stderr():  # kept short, because it also suppresses progress bars
                while place <= number and video.grab():
                    place += 1
                if place <= number:
                    raise ValueError
                picture = np.ascontiguousarray(_picture(video)[..., ::-1])
            yield picture


def _candidates(film: Path) -> list[_Candidate]:
    """Return evenly spaced frames with the measurements needed to choose among them.

    Raises InputError.
    """
    import cv2

    found: list[_Candidate] = []
    step = 1
    with _opened(film) as video:
        number, stated = 0, video.get(cv2.CAP_PROP_FRAME_COUNT)
        with native_stderr():
            while video.grab():
                if number % step == 0:
                    found.append(_candidate(number, _picture(video)))
                if len(found) >= _CANDIDATES:
                    found, step = found[::2], 2 * step
                number += 1
        if not found:
            raise ValueError
    if number < 0.8 * stated:
        raise InputError(
            f"the video is incomplete: only {number} of {stated:.0f} frames can be read",
            film,
            hint="Copy it again",
        )
    return found


def _candidate(number: int, picture: NDArray[np.uint8]) -> _Candidate:
    import cv2

    def reduced(image: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
        share = side / max(image.shape[:2])
        size = max(1, round(image.shape[1] * share)), max(1, round(image.shape[0] * share))
        if share >= 1:
            return image
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)

    small = reduced(picture, 512)
    gray = small.astype(np.float32).mean(axis=2)
    sharpness = float(
        np.abs(cv2.Laplacian(gray, cv2.CV_32F)).mean() / max(float(gray.mean()), 1e-3)
    )
    clipped = float((small.max(axis=2) >= 250).mean())
    stored = np.asarray(reduced(small, 64) / 255, np.float32)
    linear = np.asarray(decode_transfer(stored, BT709).mean(axis=2), np.float32)
    return number, linear.ravel(), sharpness, clipped


def _farthest(thumbnails: Float32Array) -> list[int]:
    """Return the positions of the thumbnails (N, P) that differ most, ignoring their brightness.

    Each is the farthest from those already chosen. Unit vectors less than 0.05 apart are considered
    to have the same light.
    """
    if not len(thumbnails):
        return []
    vectors = unit(thumbnails)
    distance = np.linalg.norm(vectors - vectors.mean(axis=0), axis=1)
    chosen = [int(distance.argmax())]
    distance = np.linalg.norm(vectors - vectors[chosen[0]], axis=1)
    while len(chosen) < MOST_FRAMES and distance.max() >= 0.05:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(vectors - vectors[chosen[-1]], axis=1))
    return chosen


@contextmanager
def _opened(film: Path) -> Iterator[cv2.VideoCapture]:
    """Yield an opened video, and convert the errors raised for a damaged video to an InputError."""
    import cv2

    check_file(film, "a video")
    problem = "the video is damaged or its format is not supported"
    hint = "Copy it again, or convert it to MP4 with H.264"
    with damage_as_input_error(film, problem, hint), film.open("rb") as file:
        if not _CONTAINERS.match(file.read(16)):
            raise InputError(
                "the file is not a video",
                film,
                hint="MP4, MOV, AVI, MKV and WebM files are supported",
            )
        file.seek(0)
        # FFmpeg's threads also print between calls. OpenCV reads this variable when it opens the
        # first video.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET
        with native_stderr():
            video = cv2.VideoCapture(utf8_name(film, file), cv2.CAP_FFMPEG)
        try:
            if not video.isOpened():
                raise ValueError
            height, width = (
                int(video.get(side))
                for side in (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH)
            )
            check_stored_size((height, width, 3), 1, film)
            yield video
        finally:
            with native_stderr():
                video.release()


def _picture(video: cv2.VideoCapture) -> NDArray[np.uint8]:
    """Return the most recently grabbed frame, (H, W, 3) in BGR order. Raises ValueError."""
    done, picture = video.retrieve()
    if not done or picture is None or picture.ndim != 3:
        raise ValueError
    return np.asarray(picture, np.uint8)
