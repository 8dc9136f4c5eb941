"""Pictures and films beside records, which anybody may have written: decoded, bounded, copied without anything else.

A PNG is drawn anew. A WebP and an H.264 film are decoded to the last pixel, and their coded images alone are copied: to
code them again would cost quality with every copy, and minutes.
"""

import io
import struct
import warnings
from pathlib import Path
from urllib.parse import quote

import imageio_ffmpeg
from PIL import Image

from rewild4d.errors import UserError
from rewild4d.files import regular_inside
from rewild4d.foreign.programs import run_foreign

PICTURES, FILMS = {".png": "PNG", ".webp": "WEBP"}, (".mp4",)
"""Suffixes of what is published, and the formats that they stand for."""
MOST_BYTES = 64 << 20
"""Of one file."""
MOST_PIXELS = 1 << 26
"""Of a picture, and of a frame of a film."""
THUMBNAIL_WIDTH = 320
"""Pixels, of the small pictures beside the runs of a table."""
TIMEOUT = 120.0
"""Seconds that ffmpeg may take for a film."""
warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # above 89 million; `MOST_PIXELS` is an error
_CODED = (b"VP8 ", b"VP8L")
"""Chunks of a WebP file that are coded images; metadata and animation are others."""


def publish(source: Path, folder: Path, target: Path, timeout: float = TIMEOUT) -> None:
    """Copy a picture (.png, .webp) or a film (.mp4, H.264) into a place that others will read.

    Args:
        source: of a suffix in `PICTURES` or `FILMS`, as the target.
        folder: where the file has to lie when all links are followed.
        target: the copy; nothing is left there after an error.
        timeout: seconds that ffmpeg may take.

    Raises:
        UserError: it is no regular file in the folder, too large, or not decodable as what its name says.
    """
    regular_inside(source, folder)
    suffix = source.suffix.lower()
    if suffix not in PICTURES and suffix not in FILMS:
        known = ", ".join((*PICTURES, *FILMS))
        raise UserError(f"{source}: expected a picture or a film ({known}), got another kind of file.")
    if (size := source.stat().st_size) > MOST_BYTES:
        raise UserError(f"{source}: expected at most {MOST_BYTES >> 20} MiB, got {size / 2**20:.0f} MiB.")
    try:
        if suffix in FILMS:
            recode(source, target, ("-c:v", "copy"), timeout)
        else:
            _copy_picture(source, target, PICTURES[suffix])
    except UserError:
        target.unlink(missing_ok=True)
        raise


def shrink(source: Path, target: Path) -> None:
    """Write a picture at `THUMBNAIL_WIDTH`, as WebP.

    Args:
        source: one that was published.
        target: its small copy.

    Raises:
        UserError: `source` is no picture that can be decoded.
    """
    image = open_picture(source, PICTURES[source.suffix.lower()], source).convert("RGB")
    high = max(1, round(image.height * THUMBNAIL_WIDTH / image.width))
    image.resize((THUMBNAIL_WIDTH, high), Image.Resampling.LANCZOS).save(target, "WEBP", quality=80)


def open_picture(source: Path | io.BytesIO, kind: str, title: Path) -> Image.Image:
    """Decode a picture of a bounded number of pixels.

    Args:
        source: the file or its bytes.
        kind: "PNG" or "WEBP".
        title: what the error calls it.

    Raises:
        UserError: so it is not.
    """
    try:
        with Image.open(source, formats=(kind,)) as image:
            if image.width * image.height > MOST_PIXELS:
                shape = f"{image.width} x {image.height}"
                raise UserError(f"{title}: expected at most {MOST_PIXELS / 1e6:.0f} million pixels, got {shape}.")
            image.load()
            return image
    except (OSError, SyntaxError, ValueError, EOFError, struct.error, Image.DecompressionBombError) as error:
        raise UserError(f"{title}: expected a picture, got a damaged one ({str(error)[:100]}).") from error


def _copy_picture(source: Path, target: Path, kind: str) -> None:
    if kind == "WEBP" and (bare := _bare_webp(source.read_bytes())) is not None:
        open_picture(io.BytesIO(bare), kind, source)
        target.write_bytes(bare)
        return
    image = open_picture(source, kind, source)
    clear = "A" in image.getbands() or "transparency" in image.info
    plain = image.convert("RGBA" if clear else "RGB")
    plain.info.clear()  # comments, profiles and the like would be written again
    plain.save(target, kind, **({"compress_level": 3} if kind == "PNG" else {"quality": 90}))


def _bare_webp(data: bytes) -> bytes | None:
    """Return a WebP file of the coded image alone; None where there is none, more than one, or transparency beside."""
    place, chunks = 12, []
    while place + 8 <= len(data):
        name, size = struct.unpack_from("<4sI", data, place)
        chunks.append((name, data[place + 8 : place + 8 + size]))
        place += 8 + size + size % 2
    coded = [(name, body) for name, body in chunks if name in _CODED]
    if len(coded) != 1 or any(name in (b"ALPH", b"ANIM") for name, _ in chunks):
        return None
    ((name, body),) = coded
    chunk = struct.pack("<4sI", name, len(body)) + body + b"\0" * (len(body) % 2)
    return struct.pack("<4sI4s", b"RIFF", 4 + len(chunk), b"WEBP") + chunk


def recode(source: Path, target: Path, coding: tuple[str, ...], timeout: float = TIMEOUT) -> None:
    """Write the images of an H.264 film as a film of nothing else, after all of them were decoded.

    Args:
        source: read as MP4 and H.264, whatever else it may be: a playlist could name other files.
        target: the film.
        coding: ffmpeg's options for the new one.
        timeout: seconds that ffmpeg may take.

    Raises:
        UserError: it is no such film, or damaged.
    """
    read = ("-nostdin", "-y", "-v", "error", "-xerror", "-threads", "1", "-protocol_whitelist", "file", "-f", "mov",
            "-codec_whitelist", "h264", "-max_pixels", str(MOST_PIXELS), "-i", f"file:{source}")  # fmt: skip
    bare = ("-map_metadata", "-1", "-map_chapters", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact",
            "-movflags", "+faststart", "-f", "mp4", f"file:{target}")  # fmt: skip
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    decoded = ("-map", "0:v:0", "-f", "null", "-")
    ended = run_foreign((ffmpeg, *read, "-map", "0:v:0", *coding, *bare, *decoded), timeout=timeout, flag="ffmpeg")
    if ended.status:
        said = ended.said.removeprefix(f"file:{source}: ").rstrip(".") or f"exit status {ended.status}"
        raise UserError(f"{source}: expected an H.264 film in MP4, but ffmpeg says: {said}.")


def link(name: str) -> str:
    """Return the address of a file beside a page; no name is taken for a scheme ("javascript:...") or a folder."""
    return quote(name, safe="")
