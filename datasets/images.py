"""Decode image files to small premultiplied RGBA on disk: cut a window, average it down, keep it.

A framing is one window of the source image per view; the window may reach over the border, where it is transparent.
So "full", "letterbox" and "crop" share one path, and `Window.camera` moves the camera with the pixels.
"""

import math
import re
import struct
import zlib
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from tqdm import tqdm

from rewild4d.contracts import Selection
from rewild4d.errors import UserError
from rewild4d.files import atomic, cache_folder, digest, file_state
from rewild4d.foreign.reading import picture_size, read_bytes
from rewild4d.types import Camera

BOX_ALPHA = 25
"""Mattes above a tenth make the box of a crop, so that noise in a matte does not widen it."""
CROP_MARGIN = 0.075
"""Free border on each side of a crop as a share of the animal's longer side: 15 % in all."""
_THREADS = 2
_CACHE_VERSION = "2"
ORIENTATION = 0x0112
"""EXIF tag of an image's rotation."""
_FLIPS = {2: (1, -1), 3: (-1, -1), 4: (-1, 1), 6: (1, -1), 7: (-1, -1), 8: (-1, 1)}
"""Steps along rows and columns of an upright picture, by EXIF orientation."""


@dataclass(frozen=True)
class ImagePair:
    """The two files of one view at one frame."""

    rgb: Path
    alpha: Path


@dataclass(frozen=True)
class Window:
    """A rectangle of the source image in whole pixels; it may reach over the border."""

    left: int
    top: int
    width: int
    height: int

    def camera(self, camera: Camera, width: int, height: int) -> Camera:
        """Return the camera of the window once resized to width x height."""
        return camera.shifted(self.left, self.top, self.width, self.height).resized(width, height)


@dataclass(frozen=True)
class Decoded:
    """The decoded images of a motion.

    Attributes:
        rgba: premultiplied, uint8 memory map, [frames, views, h, w, 4].
        windows: one a view.
        source: width and height of the image files.
    """

    rgba: np.ndarray
    windows: tuple[Window, ...]
    source: tuple[int, int]


def read_rgb(path: Path, upright: bool = False) -> np.ndarray:
    """Return the colour image, uint8 [h, w, 3]; an alpha channel inside the file is ignored.

    Args:
        path: PNG or JPEG.
        upright: rotate the image as its EXIF tag says; not where a camera was calibrated on the stored pixels.

    Raises:
        UserError: the file cannot be read, or is cut off or damaged.
    """
    return cv2.cvtColor(_decode(path, cv2.IMREAD_COLOR, upright), cv2.COLOR_BGR2RGB)


def read_alpha(path: Path) -> np.ndarray:
    """Return a matte of any PNG mode, uint8 [h, w]: alpha where it is not opaque all over, else the luminance.

    Raises:
        UserError: the file cannot be read, or is cut off or damaged.
    """
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.dtype == np.uint16:
        image = np.rint(image / 257).astype(np.uint8)
    if image.ndim == 2:
        return image
    if image.shape[2] == 4 and (image[..., 3] < 255).any():
        return np.ascontiguousarray(image[..., 3])
    return cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY)


def read_picture(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Read colour and, where there is one, straight alpha of a PNG or JPEG of any mode, turned as its EXIF tag says.

    Returns:
        Colour in [0, 1], float32 [h, w, 3], and alpha in [0, 1], float32 [h, w], or None; errors as `read_rgb`.
    """
    image = _upright(path, _decode(path, cv2.IMREAD_UNCHANGED))
    scaled = image.astype(np.float32) / np.iinfo(image.dtype).max
    if scaled.ndim == 2:
        return np.repeat(scaled[..., None], 3, axis=2), None
    return scaled[..., 2::-1], scaled[..., 3] if scaled.shape[2] == 4 else None


def read_pair(pair: ImagePair, source: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the colour and matte of one view.

    Args:
        pair: the files.
        source: width and height that both must have; None: any, but the same.

    Raises:
        UserError: as `read_rgb`, or a size that differs.
    """
    rgb = read_rgb(pair.rgb)
    expect_size(pair.rgb, rgb, source, "the other images")
    alpha = read_alpha(pair.alpha)
    expect_size(pair.alpha, alpha, (rgb.shape[1], rgb.shape[0]), pair.rgb.name)
    return rgb, alpha


def target_size(source: tuple[int, int], selection: Selection) -> tuple[int, int]:
    """Return the width and height of the images that a selection asks for."""
    if selection.framing != "full":
        return selection.size, selection.size
    scale = selection.size / max(source)
    return max(1, round(source[0] * scale)), max(1, round(source[1] * scale))


def size_within(size: tuple[int, int], side: int) -> tuple[int, int]:
    """Return the width and height that an image is shrunk to so that neither is above ``side`` pixels."""
    scale = min(1.0, side / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def cut_window(rgb: np.ndarray, alpha: np.ndarray, window: Window, size: tuple[int, int]) -> np.ndarray:
    """Cut a window out of an image and average it down to ``size``, colour weighted by the matte, uint8 [h, w, 4]."""
    height, width = alpha.shape
    left, top = max(window.left, 0), max(window.top, 0)
    right, bottom = min(window.left + window.width, width), min(window.top + window.height, height)
    canvas = np.zeros((window.height, window.width, 4), dtype=np.float32)
    inside = canvas[top - window.top : bottom - window.top, left - window.left : right - window.left]
    matte = alpha[top:bottom, left:right].astype(np.float32)
    inside[..., 3] = matte
    np.multiply(rgb[top:bottom, left:right], matte[..., None] / 255, out=inside[..., :3])
    shrinks = size[0] < window.width
    small = cv2.resize(canvas, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.clip(np.rint(small), 0, 255).astype(np.uint8)


def decode(pairs: Sequence[Sequence[ImagePair]], selection: Selection, title: str) -> Decoded:
    """Decode the images of a motion, or take them from the cache.

    Args:
        pairs: the files, [frames][views].
        selection: gives size and framing; "crop" takes a view's window from all the frames given here.
        title: for the progress bar.

    Raises:
        UserError: a damaged file, images of differing sizes, a matte of another size, a cache that cannot be written.
    """
    folder = cache_folder() / "artemis" / _key(pairs, selection)
    images, windows = folder / "rgba.npy", folder / "windows.npy"
    if not images.is_file():
        _fill_cache(pairs, selection, title, images, windows)
    source_and_windows = np.load(windows)
    return Decoded(
        rgba=np.load(images, mmap_mode="r"),
        windows=tuple(Window(*map(int, row)) for row in source_and_windows[1:]),
        source=(int(source_and_windows[0, 2]), int(source_and_windows[0, 3])),
    )


def _fill_cache(
    pairs: Sequence[Sequence[ImagePair]], selection: Selection, title: str, images: Path, windows: Path
) -> None:
    first = read_rgb(pairs[0][0].rgb)
    source = (first.shape[1], first.shape[0])
    framed = _windows(pairs, selection, source, title)
    with atomic(windows) as temporary, temporary.open("wb") as file:
        rows = [(0, 0, *source), *((w.left, w.top, w.width, w.height) for w in framed)]
        np.save(file, np.array(rows, dtype=np.int64))
    size = target_size(source, selection)
    jobs = [(pair, window) for frame in pairs for pair, window in zip(frame, framed, strict=True)]

    def work(job: tuple[ImagePair, Window]) -> np.ndarray:
        return cut_window(*read_pair(job[0], source), job[1], size)

    header = {"descr": "|u1", "fortran_order": False, "shape": (len(pairs), len(framed), size[1], size[0], 4)}
    # Written last: its presence says that the cache is complete.
    with atomic(images) as temporary, temporary.open("wb") as file, ThreadPoolExecutor(_THREADS) as pool:
        np.lib.format.write_array_header_1_0(file, header)
        for small in tqdm(pool.map(work, jobs), total=len(jobs), desc=f"decoding {title}", disable=None, leave=False):
            file.write(small.tobytes())


def _windows(
    pairs: Sequence[Sequence[ImagePair]], selection: Selection, source: tuple[int, int], title: str
) -> list[Window]:
    """Return the window of each view."""
    views = list(zip(*pairs, strict=True))
    whole = Window(0, 0, *source)
    if selection.framing == "full":
        return [whole] * len(views)
    if selection.framing == "letterbox":
        return [_square(whole, max(source))] * len(views)
    progress = tqdm(views, desc=f"framing {title}", disable=None, leave=False)
    with ThreadPoolExecutor(_THREADS) as pool:
        boxes = [_box(pool.map(lambda pair: read_alpha(pair.alpha), view)) for view in progress]
    sides = [max(box.width, box.height) if box else 0 for box in boxes]
    return [
        _square(box, side + 2 * math.ceil(CROP_MARGIN * side)) if box else _square(whole, max(source))
        for box, side in zip(boxes, sides, strict=True)
    ]


def _square(box: Window, side: int) -> Window:
    """Return the square of a given side around the centre of a box."""
    return Window(box.left + (box.width - side) // 2, box.top + (box.height - side) // 2, side, side)


def _box(mattes: Iterable[np.ndarray]) -> Window | None:
    """Return the rectangle that holds the animal in all mattes, or None where there is no animal."""
    corners = []
    for matte in mattes:
        left, top, width, height = cv2.boundingRect((matte > BOX_ALPHA).astype(np.uint8))
        if width:
            corners.append((left, top, left + width, top + height))
    if not corners:
        return None
    lower, upper = np.min(corners, axis=0), np.max(corners, axis=0)
    return Window(int(lower[0]), int(lower[1]), int(upper[2] - lower[0]), int(upper[3] - lower[1]))


def _key(pairs: Sequence[Sequence[ImagePair]], selection: Selection) -> str:
    """Return the digest of the source files (path, size, time of change), the framing and the size."""
    parts = [_CACHE_VERSION, selection.framing, str(selection.size), str(len(pairs))]
    for frame in pairs:
        for pair in frame:
            parts += [file_state(path) for path in (pair.rgb, pair.alpha)]
    return digest(*parts)[:32]


def expect_size(path: Path, image: np.ndarray, size: tuple[int, int] | None, other: str) -> None:
    """Raise a `UserError` where an image [h, w, ...] differs from the width and height of ``other``; None: any."""
    if size and (image.shape[1], image.shape[0]) != size:
        raise UserError(
            f"{path}: expected {size[0]}x{size[1]} pixels like {other}, got {image.shape[1]}x{image.shape[0]}."
        )


def _decode(path: Path, mode: int, upright: bool = False) -> np.ndarray:
    data = read_bytes(path, "an image that can be read")
    picture_size(path, data)
    fault = _fault(data)
    # Cameras know nothing of EXIF, so an orientation tag must not rotate the image.
    mode = mode if upright else mode | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = None if fault else cv2.imdecode(np.frombuffer(data, dtype=np.uint8), mode)
    except cv2.error:  # more pixels than it takes
        image = None
    if image is None:
        raise UserError(f"{path}: expected a whole image, got {fault or 'a damaged one'}.")
    return image


def _upright(path: Path, image: np.ndarray) -> np.ndarray:
    """Apply what OpenCV ignores in an unchanged file: its EXIF rotation, and one grey that means transparent."""
    with Image.open(path) as stored:
        orientation = stored.getexif().get(ORIENTATION, 1)
        if image.ndim == 2 and stored.mode == "L" and isinstance(stored.info.get("transparency"), int):
            alpha = np.where(image == stored.info["transparency"], 0, 255).astype(np.uint8)
            image = np.dstack((image, image, image, alpha))
    image = image.swapaxes(0, 1) if orientation >= 5 else image
    # 1 to 8: as it is, mirrored, upside down, flipped; and the same after rows and columns were exchanged.
    rows, columns = _FLIPS.get(orientation, (1, 1))
    return image[::rows, ::columns]


def _fault(data: bytes) -> str:
    """Return what is wrong with an image file, or "": OpenCV returns half an image where a file is cut off."""
    kind = "PNG" if data.startswith(b"\x89PNG") else "JPEG" if data.startswith(b"\xff\xd8") else ""
    if not kind:
        return "a file that is neither PNG nor JPEG" if data else "an empty file"
    try:
        with Image.open(BytesIO(data), formats=[kind]) as image:
            if kind == "PNG":
                image.verify()
            else:
                image.draft("L", (1, 1))  # the whole file is read, an eighth of its pixels made
                image.load()
    except Image.DecompressionBombError:  # OpenCV has a limit of its own
        return ""
    except (OSError, SyntaxError, ValueError, LookupError, EOFError, struct.error, zlib.error) as error:
        damaged = re.search(r"checksum in b'(\w+)'", str(error))
        fault = f"with a damaged {damaged[1]} chunk" if damaged else f"that is cut off after {len(data)} bytes"
        return f"a {kind} {fault}"
    return ""
