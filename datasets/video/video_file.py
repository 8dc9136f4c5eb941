"""Video files, frame by frame with their own time stamps: any codec that ffmpeg knows, turned upright, with alpha.

What the header asks for is done (`video_header`): pixels are made square, interlaced frames whole, PQ and HLG plain.

Frames come through a pipe as PAM images, which say their own size; the time stamps come from ffmpeg's `showinfo`, so a
variable frame rate keeps its times.
"""

import re
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO

import imageio_ffmpeg
import numpy as np

from rewild4d.datasets.video.video_header import read_header
from rewild4d.errors import UserError
from rewild4d.files import file_state

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".gif", ".mpg", ".mpeg", ".wmv", ".ts", ".3gp")
_TIME = re.compile(r"showinfo.*\bn: *\d+ .*\bpts_time:(\S+)")
_FAULT = re.compile(r"\[(?:error|fatal)\] (.+)")
_SHAPE = re.compile(r"showinfo.*\bn: *\d+ .*\bs:(\d+)x(\d+)")
ASSUMED_FPS = 25.0
"""Of a video without time stamps that ascend."""
UNEVEN = 1.5
"""A frame rate varies where the longest time between frames is so many times the shortest."""


@dataclass(frozen=True)
class VideoFacts:
    """What one pass over a video tells.

    Attributes:
        times: of the frames in seconds, the first one 0, ascending.
        width: of the upright frames in pixels.
        height: of the upright frames in pixels.
        has_alpha: whether any frame is transparent anywhere.
        faults: what ffmpeg complained of ("" where of nothing).
        is_stamped: whether the times are the file's own; where its stamps are missing or out of order, they are those
            of `ASSUMED_FPS` frames a second.
        stored: width and height of the upright frames before their pixels were made square.
        treated: what the header asked for beside that, a sentence each.
    """

    times: tuple[float, ...]
    width: int
    height: int
    has_alpha: bool
    faults: str
    is_stamped: bool = True
    stored: tuple[int, int] = (0, 0)
    treated: tuple[str, ...] = ()

    @property
    def is_stretched(self) -> bool:
        """Whether the pixels were made square."""
        return self.stored != (self.width, self.height)

    @property
    def changes(self) -> tuple[str, ...]:
        """How the frames differ from those that the file stores, a sentence each."""
        squared = f"pixels made square: {self.stored[0]}x{self.stored[1]} stretched to {self.width}x{self.height}"
        return (*([squared] if self.is_stretched else []), *self.treated)

    @property
    def pace(self) -> str:
        """A sentence where the frame rate varies, or was assumed; "" elsewhere."""
        if not self.is_stamped:
            return f"time stamps are missing or out of order: {ASSUMED_FPS:g} frames a second assumed"
        steps = np.diff(self.times)
        if len(steps) < 2 or steps.max() < UNEVEN * steps.min():
            return ""
        slowest, fastest = 1 / steps.max(), 1 / steps.min()
        return f"the frame rate varies, {slowest:.3g} to {fastest:.3g} a second: each frame keeps its own time"


def read_video(path: Path, indices: Sequence[int] | None = None) -> Iterator[np.ndarray]:
    """Yield frames of a video, upright, uint8 [h, w, 4] (alpha is 255 where the video has none).

    Args:
        path: the video.
        indices: which frames, ascending; None: all of them.

    Raises:
        UserError: ffmpeg cannot read the file.
    """
    first, last = (indices[0], indices[-1]) if indices else (0, None)
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as log:
        wanted = None if indices is None else {*indices}
        for index, frame in enumerate(_frames(path, log, first, last), first):
            if wanted is None or index in wanted:
                yield frame


def video_facts(path: Path) -> VideoFacts:
    """Return times and size of a video, by decoding all of it; kept until the file changes.

    Raises:
        UserError: ffmpeg cannot read the file, or it holds no frame.
    """
    try:
        state = path.stat()
    except OSError as error:
        raise UserError(f"{path}: expected a video, but: {error.strerror}.") from error
    return _facts(path, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=8)
def _facts(path: Path, size: int, changed: int) -> VideoFacts:
    header = read_header(path, file_state(path))
    count, width, height, has_alpha = 0, 0, 0, False
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as log:
        for frame in _frames(path, log, 0, None if header.may_be_clear else 0):
            count, (height, width) = count + 1, frame.shape[:2]
            has_alpha = has_alpha or bool((frame[..., 3] < 255).any())
        if count and not header.may_be_clear:
            log.seek(0)
            log.truncate()
            subprocess.run([*_decoding(path, "showinfo=checksum=0"), "-f", "null", "-"], stderr=log, check=False)
        log.seek(0)
        said = log.read()
    stamps = re.findall(_TIME, said)
    count = count if header.may_be_clear else len(stamps)
    if not count:
        raise UserError(f"{path}: expected a video that ffmpeg can read, got {_complaint(said) or 'no frame'}.")
    times = ascending(stamps, count)
    assumed = tuple(i / ASSUMED_FPS for i in range(count))
    shape = re.search(_SHAPE, said)
    stored = (int(shape[1]), int(shape[2])) if shape else (width, height)
    is_stamped = times is not None
    return VideoFacts(times or assumed, width, height, has_alpha, _complaint(said), is_stamped, stored, header.changes)


def ascending(stamps: list[str], count: int) -> tuple[float, ...] | None:
    """Return times from the first frame on; None where stamps are missing or do not ascend."""
    try:
        times = [float(stamp) for stamp in stamps[:count]]
    except ValueError:
        times = []
    if len(times) < count or any(after <= before for before, after in zip(times, times[1:], strict=False)):
        return None
    return tuple(time - times[0] for time in times)


def _complaint(said: str) -> str:
    found = re.search(_FAULT, said)
    return found.group(1).strip().rstrip(".") if found else ""


def _frames(path: Path, log: IO[str], first: int = 0, last: int | None = None) -> Iterator[np.ndarray]:
    """Decode, and yield frames from the first to the last that is wanted; ffmpeg's words go to ``log``."""
    filters = ["showinfo=checksum=0", *read_header(path, file_state(path)).filters]
    until = [] if last is None else ["-frames:v", str(last - first + 1)]
    if first:  # fields need the frames around them, so that frames are left out after that
        filters.insert(1 + sum("bwdif" in name for name in filters), f"select=gte(n\\,{first})")
    command = [*_decoding(path, ",".join(filters)), *until, "-pix_fmt", "rgba", "-c:v", "pam", "-f", "image2pipe", "-"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log) as process:
        assert process.stdout is not None
        while (frame := _pam(process.stdout)) is not None:
            yield frame


def _decoding(path: Path, filters: str) -> list[str]:
    """Return ffmpeg's command up to what it makes of the frames."""
    return [
        imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin", "-nostats", "-loglevel", "level+info",
        *read_header(path, file_state(path)).decoder, "-i", f"file:{path}", "-map", "0:v:0",
        "-fps_mode", "passthrough", "-vf", filters,
    ]  # fmt: skip


def _pam(pipe: IO[bytes]) -> np.ndarray | None:
    """Return the next image of a stream, or None at its end."""
    header: dict[bytes, bytes] = {}
    while (line := pipe.readline()) and line != b"ENDHDR\n":
        key, _, value = line.strip().partition(b" ")
        header[key] = value
    if not line:
        return None
    shape = tuple(int(header[key]) for key in (b"HEIGHT", b"WIDTH", b"DEPTH"))
    data = pipe.read(shape[0] * shape[1] * shape[2])
    if len(data) < shape[0] * shape[1] * shape[2]:
        return None
    return np.frombuffer(data, np.uint8).reshape(shape)
