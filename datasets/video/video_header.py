"""What a video's header asks for: a decoder that keeps transparency, square pixels, whole frames, plain colours."""

import re
import subprocess
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import imageio_ffmpeg

from rewild4d.errors import UserError
from rewild4d.foreign.reading import PIXEL, require_room

_STREAM = re.compile(r"Stream #.*Video:.*")
_SIZE = re.compile(r", (\d{1,7})x(\d{1,7})\b")
_ASPECT = re.compile(r"\bSAR (\d+):(\d+)")
_FIELDS = re.compile(r"\b(?:top|bottom) (?:coded )?first\b")
_CLEAR = re.compile(r"\b(?:yuva|rgba|bgra|argb|abgr|gbrap|ya8|ya16|pal8)")
MOST_ASPECT = 10.0
"""Width over height of a pixel, or height over width, beyond which a header is wrong."""
HIGH_RANGE = {"smpte2084": "PQ", "arib-std-b67": "HLG"}
"""Transfer functions of high dynamic range (ITU-R BT.2100) as ffmpeg calls them, and as people do."""
WHITE = 203
"""Luminance of paper in such films, candelas a square metre (ITU-R BT.2408), which becomes white."""
KNEE = 0.8
"""Share of white up to which colours stay as they are; what is brighter is compressed (Moebius curve)."""


@dataclass(frozen=True)
class Header:
    """What a header asks for.

    Attributes:
        decoder: arguments of ffmpeg before the file.
        filters: of ffmpeg, in order.
        changes: what they change, a sentence each; of square pixels `VideoFacts` tells.
        may_be_clear: whether frames may be transparent.
    """

    decoder: tuple[str, ...]
    filters: tuple[str, ...]
    changes: tuple[str, ...]
    may_be_clear: bool


@lru_cache(maxsize=8)
def read_header(path: Path, state: str) -> Header:
    """Read the header of a video.

    Args:
        path: the video.
        state: changes with the file.

    Raises:
        UserError: pixels of a shape that no camera has, or more of them than `reading.largest` lets in.
    """
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin", "-i", f"file:{path}"]
    said = subprocess.run(command, capture_output=True, text=True, errors="replace").stderr
    stream = found[0] if (found := re.search(_STREAM, said)) else ""
    if size := re.search(_SIZE, stream):
        width, height = map(int, size.groups())
        require_room(path, PIXEL * width * height, f"frames of a video, {width}x{height} pixels,")
    decoder: tuple[str, ...] = ()
    if re.search(r"alpha_mode\s*: 1", said, re.IGNORECASE):  # ffmpeg's own VP8 and VP9 decoders drop it
        decoder = ("-c:v", "libvpx-vp9" if "Video: vp9" in said else "libvpx")
    filters, changes = [], []
    if re.search(_FIELDS, stream):
        filters.append("bwdif=mode=send_frame:deint=interlaced")
        changes.append("interlaced: each frame is made whole from its first field and what lies between the second's")
    if curve := next((curve for curve in HIGH_RANGE if curve in stream), None):
        filters += _plain_colors()
        changes.append(f"{HIGH_RANGE[curve]}, high dynamic range: brought to sRGB's, {WHITE} cd/m2 as white")
    filters += _square_pixels(path, stream)
    return Header(decoder, tuple(filters), tuple(changes), bool(decoder or re.search(_CLEAR, stream)))


def _plain_colors() -> list[str]:
    """Return filters from ITU-R BT.2100 to BT.709."""
    return [
        f"zscale=t=linear:npl={WHITE}", "format=gbrpf32le", "zscale=p=bt709", f"tonemap=mobius:param={KNEE}:desat=0",
        "zscale=t=bt709:m=bt709:r=tv", "format=yuv444p",
    ]  # fmt: skip


def _square_pixels(path: Path, stream: str) -> list[str]:
    """Return the filter that makes pixels square; none where they are.

    Where the container says another shape than the stream in it, both are there, and the container's counts.
    """
    shapes = re.findall(_ASPECT, stream)
    across, down = map(int, shapes[-1]) if shapes else (1, 1)
    if across == down or not across or not down:
        return []
    if not 1 / MOST_ASPECT <= across / down <= MOST_ASPECT:
        raise UserError(f"{path}: expected pixels that are about square, got some of {across}:{down}.")
    return ["scale=w='max(1,round(iw*sar))':h=ih", "setsar=1"]  # turned frames have their own ratio
