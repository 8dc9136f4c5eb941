"""Video files, frame by frame with their own time stamps: any codec that ffmpeg knows, turned upright, with alpha.

Pixels are made square: where the header says that they are wider than high, or less, frames are stretched across.

Frames come through a pipe as PAM images, which say their own size; the time stamps come from ffmpeg's `showinfo`, so a
variable frame rate keeps its times.
"""

import re
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO

import imageio_ffmpeg
import numpy as np

from rewild4d.errors import UserError
from rewild4d.files import file_state
from rewild4d.foreign.reading import PIXEL, require_room

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".gif", ".mpg", ".mpeg", ".wmv", ".ts", ".3gp")
_TIME = re.compile(r"showinfo.*\bn: *\d+ .*\bpts_time:(\S+)")
_FAULT = re.compile(r"\[(?:error|fatal)\] (.+)")
_SHAPE = re.compile(r"showinfo.*\bn: *\d+ .*\bs:(\d+)x(\d+)")
_STREAM = re.compile(r"Stream #.*Video:.*")
_SIZE = re.compile(r", (\d{1,7})x(\d{1,7})\b")
_ASPECT = re.compile(r"\bSAR (\d+):(\d+)")
MOST_ASPECT = 10.0
"""Width over height of a pixel, or height over width, beyond which a header is wrong."""
ASSUMED_FPS = 25.0
"""Of a video without time stamps that ascend."""


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
    """

    times: tuple[float, ...]
    width: int
    height: int
    has_alpha: bool
    faults: str
    is_stamped: bool = True
    stored: tuple[int, int] = (0, 0)

    @property
    def squared(self) -> str:
        """A sentence where the pixels were made square; "" where they were."""
        if self.stored == (self.width, self.height):
            return ""
        return f"pixels made square: {self.stored[0]}x{self.stored[1]} stretched to {self.width}x{self.height}"


def read_video(path: Path) -> Iterator[np.ndarray]:
    """Yield every frame of a video, upright, uint8 [h, w, 4] (alpha is 255 where the video has none).

    Raises:
        UserError: ffmpeg cannot read the file.
    """
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as log:
        yield from _frames(path, log)


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
    count, width, height, has_alpha = 0, 0, 0, False
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as log:
        for frame in _frames(path, log):
            count, (height, width) = count + 1, frame.shape[:2]
            has_alpha = has_alpha or bool((frame[..., 3] < 255).any())
        log.seek(0)
        said = log.read()
    if not count:
        raise UserError(f"{path}: expected a video that ffmpeg can read, got {_complaint(said) or 'no frame'}.")
    times = ascending(re.findall(_TIME, said), count)
    assumed = tuple(i / ASSUMED_FPS for i in range(count))
    shape = re.search(_SHAPE, said)
    stored = (int(shape[1]), int(shape[2])) if shape else (width, height)
    return VideoFacts(times or assumed, width, height, has_alpha, _complaint(said), times is not None, stored)


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


def _frames(path: Path, log: IO[str]) -> Iterator[np.ndarray]:
    """Decode; ffmpeg's words go to ``log``."""
    decoder, square = _header(path, file_state(path))
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin", "-nostats", "-loglevel", "level+info",
        *decoder, "-i", f"file:{path}", "-map", "0:v:0", "-fps_mode", "passthrough",
        "-vf", f"showinfo=checksum=0{square}", "-pix_fmt", "rgba", "-c:v", "pam", "-f", "image2pipe", "-",
    ]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log) as process:
        assert process.stdout is not None
        while (frame := _pam(process.stdout)) is not None:
            yield frame


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


@lru_cache(maxsize=8)
def _header(path: Path, state: str) -> tuple[tuple[str, ...], str]:
    """Return the decoder that the header asks for, and the filter that makes pixels square ("" where they are).

    ffmpeg's own VP8 and VP9 decoders drop the alpha channel; libvpx keeps it.

    Args:
        path: the video.
        state: changes with the file.

    Raises:
        UserError: pixels of a shape that no camera has, or more of them than `reading.largest` lets in.
    """
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin", "-i", f"file:{path}"]
    said = subprocess.run(command, capture_output=True, text=True, errors="replace").stderr
    decoder: tuple[str, ...] = ()
    if re.search(r"alpha_mode\s*: 1", said, re.IGNORECASE):
        decoder = ("-c:v", "libvpx-vp9" if "Video: vp9" in said else "libvpx")
    stream = re.search(_STREAM, said)
    if stream and (size := re.search(_SIZE, stream[0])):
        width, height = map(int, size.groups())
        require_room(path, PIXEL * width * height, f"frames of a video, {width}x{height} pixels,")
    # where the container says another shape than the stream in it, both are there, and the container's counts
    shapes = re.findall(_ASPECT, stream[0]) if stream else []
    across, down = map(int, shapes[-1]) if shapes else (1, 1)
    if across == down or not across or not down:
        return decoder, ""
    if not 1 / MOST_ASPECT <= across / down <= MOST_ASPECT:
        raise UserError(f"{path}: expected pixels that are about square, got some of {across}:{down}.")
    return decoder, ",scale=w='max(1,round(iw*sar))':h=ih,setsar=1"  # turned frames have their own ratio
