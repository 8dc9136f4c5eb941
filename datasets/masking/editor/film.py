"""A film's frames for the page: decoded once, kept as JPEG files while the editor runs."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from rewild4d.datasets.masking.makers import Unmasked
from rewild4d.errors import UserError
from rewild4d.files import not_written

QUALITY, THUMB_QUALITY = 92, 75
THUMB_HEIGHT = 72
"""Pixels of a thumbnail."""


class Film:
    """Frames as JPEG files in a temporary folder; `close` removes it.

    Args:
        source: the frames.
        log: called with the number of frames so far and of all.

    Raises:
        UserError: frames that cannot be read, or no room for them.
    """

    def __init__(self, source: Unmasked, log: Callable[[int, int], None] = lambda *_: None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="rewild4d-editor-")
        self.count = len(source.stems)
        try:
            self._keep(source, log)
        except OSError as error:
            self.close()
            raise not_written(Path(self._folder.name), error) from error
        except BaseException:
            self.close()
            raise

    def _keep(self, source: Unmasked, log: Callable[[int, int], None]) -> None:
        read = 0
        for read, image in enumerate(source.images(), 1):
            pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
            self._path("frame", read - 1).write_bytes(_jpeg(pixels, QUALITY))
            wide = max(1, round(THUMB_HEIGHT * pixels.shape[1] / pixels.shape[0]))
            small = cv2.resize(pixels, (wide, THUMB_HEIGHT), interpolation=cv2.INTER_AREA)
            self._path("thumb", read - 1).write_bytes(_jpeg(small, THUMB_QUALITY))
            log(read, self.count)
        if read != self.count:
            raise UserError(f"{source.title}: expected {self.count} frames, but {read} could be read.")

    def frame(self, place: int) -> bytes:
        """Return a frame as JPEG."""
        return self._path("frame", place).read_bytes()

    def thumb(self, place: int) -> bytes:
        """Return a frame as a small JPEG."""
        return self._path("thumb", place).read_bytes()

    def image(self, place: int) -> np.ndarray:
        """Return a frame, uint8 [h, w, 3], red, green, blue."""
        pixels = cv2.imdecode(np.frombuffer(self.frame(place), np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)

    def close(self) -> None:
        self._folder.cleanup()

    def _path(self, kind: str, place: int) -> Path:
        return Path(self._folder.name) / f"{kind}{place:06d}.jpg"


def _jpeg(pixels: np.ndarray, quality: int) -> bytes:
    return cv2.imencode(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes()
